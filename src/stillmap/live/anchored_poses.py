"""Poses of all spaced scans: those that left the pose graph move with one that stayed."""

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.live.graph_sparsification import find_nearest

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]


class AnchoredPoses:
    """The spaced scans in the pose graph, by their numbers, and those that left it."""

    def __init__(self) -> None:
        self._graph = np.zeros(0, np.int64)  # numbers of the scans in the graph
        self._left = np.zeros(0, np.int64)  # numbers of those that left it
        self._anchor = np.zeros(0, np.int64)  # number of the scan with which each of them moves
        self._relative = np.zeros((0, 3))  # x, y, heading in its frame

    def remove(self, stay: Mask, poses: Float) -> None:
        """Take scans out of the graph, which from now on move with the nearest one that stays.

        Args:
            stay: (K,) of the scans in the graph, some of them new.
            poses: (K, 3, 3) T_map_base of them.
        """
        every, graph = self.place(poses), self._extend_to(len(poses))
        staying = graph[stay]
        again = ~np.isin(self._anchor, staying)
        leaving = np.concatenate([self._left[again], graph[~stay]])
        anchor = staying[find_nearest(every[leaving], every[staying])]
        relative = se2.parameters(se2.inverse(every[anchor]) @ every[leaving])
        self._left = np.concatenate([self._left[~again], leaving])
        self._anchor = np.concatenate([self._anchor[~again], anchor])
        self._relative = np.concatenate([self._relative[~again], relative])
        self._graph = staying

    def place(self, poses: Float) -> Float:
        """(S, 3, 3) T_map_base of all scans, by the poses (K, 3, 3) of those in the graph, some of
        them new."""
        graph = self._extend_to(len(poses))
        every = np.empty((len(graph) + len(self._left), 3, 3))
        every[graph] = poses
        every[self._left] = every[self._anchor] @ se2.matrix(*self._relative.T)
        return every

    def _extend_to(self, count: int) -> NDArray[np.int64]:
        """(K,) numbers of the scans in the graph, with those that were added since."""
        known = len(self._graph) + len(self._left)
        return np.append(self._graph, known + np.arange(count - len(self._graph)))
