"""Distances between points that were clicked."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.viewer.nodes import Nodes, node_path

_RED = np.array((200, 0, 60), np.uint8)
_MARK_SIZE = 0.006  # of a clicked point, as a share of the height of the view


class Ruler:
    """Clicked points, every two of which are the ends of a distance.

    Attributes:
        points: (3,) m each, relative to the scene's origin.
    """

    def __init__(self, nodes: Nodes) -> None:
        self._nodes = nodes
        self.points: list[NDArray[np.float64]] = []
        self._drawn: list[Any] = []

    @property
    def distances(self) -> list[float]:
        """In m, of the pairs that are complete."""
        ends = zip(self.points[::2], self.points[1::2], strict=False)
        return [float(np.linalg.norm(b - a)) for a, b in ends]

    def add(self, point: NDArray[np.float64]) -> None:
        """Add a point (3,), and the distance from the one before it to every second one."""
        self.points.append(point)
        count = len(self.points)
        layer = f"Measured {count}"
        self._drawn.append(self._nodes.cloud(layer, point[None], _RED[None], _MARK_SIZE))
        if count % 2 == 0:
            ends = np.stack(self.points[-2:])
            self._drawn.append(self._nodes.lines(layer, ends[None], _RED, 3.0))
            label = self._nodes.label(node_path(layer, "distance"))
            label.text, label.position = format_length(self.distances[-1]), ends.mean(axis=0)
            self._drawn.append(label)

    def clear(self) -> None:
        """Remove all points and distances."""
        for node in self._drawn:
            node.remove()
        self._drawn, self.points = [], []


def format_length(length: float) -> str:
    """A length in m, to centimeters."""
    return f"{length:.2f} m"
