"""The last seconds of the transform tree (TF), as it arrives."""

import bisect
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stillmap.core import se2
from stillmap.io.rigid_transforms import MAX_TRANSLATION

Float = NDArray[np.float64]

_NORM_TOLERANCE = 0.05  # of a quaternion


class _Edge:
    """The transform from a frame to its parent over time; `stamps` is empty if it is static."""

    def __init__(self, parent: str) -> None:
        self.parent = parent
        self.stamps: list[int] = []
        self.values: list[Float] = []  # x y z, quaternion x y z w

    def set_static(self, values: Float) -> None:
        self.stamps, self.values = [], [values]

    def insert(self, stamp_ns: int, values: Float, duration_ns: int) -> None:
        if self.values and not self.stamps:
            return  # a static transform stays
        if self.stamps and stamp_ns < self.stamps[-1] - duration_ns:
            self.stamps, self.values = [], []  # time has begun anew
        k = bisect.bisect_left(self.stamps, stamp_ns)
        if k < len(self.stamps) and self.stamps[k] == stamp_ns:
            self.values[k] = values
            return
        self.stamps.insert(k, stamp_ns)
        self.values.insert(k, values)
        old = bisect.bisect_left(self.stamps, self.stamps[-1] - duration_ns)
        del self.stamps[:old], self.values[:old]

    def at(self, stamp_ns: int) -> Float | None:
        """(4, 4); None: the stamp lies outside the known ones."""
        if not self.stamps:
            return _to_matrix(self.values[0])
        if not self.stamps[0] <= stamp_ns <= self.stamps[-1]:
            return None
        k = bisect.bisect_left(self.stamps, stamp_ns)
        after = self.values[k]
        if self.stamps[k] == stamp_ns:
            return _to_matrix(after)
        before = self.values[k - 1]
        share = (stamp_ns - self.stamps[k - 1]) / (self.stamps[k] - self.stamps[k - 1])
        sign = np.copysign(1.0, before[3:] @ after[3:])  # the shorter of both arcs
        between = before * (1.0 - share) + after * np.r_[np.ones(3), np.full(4, sign)] * share
        return _to_matrix(between)


class TransformBuffer:
    """A forest of frames of which the last seconds are known.

    Args:
        duration_ns: how long a transform is kept.
    """

    def __init__(self, duration_ns: int) -> None:
        self._duration_ns = duration_ns
        self._edges: dict[str, _Edge] = {}  # by child

    @property
    def frames(self) -> set[str]:
        """All frames."""
        return set(self._edges) | {edge.parent for edge in self._edges.values()}

    def add(
        self, parent: str, child: str, stamp_ns: int, values: Sequence[float], *, static: bool
    ) -> bool:
        """Add T_parent_child: x y z in metres and a quaternion x y z w; False: it is none."""
        if not (_is_pose(values) and parent and child and parent != child):
            return False
        edge = self._edges.get(child)
        if edge is None or edge.parent != parent:
            edge = self._edges[child] = _Edge(parent)
        pose = np.array(values, np.float64)
        if static:
            edge.set_static(pose)
        else:
            edge.insert(stamp_ns, pose, self._duration_ns)
        return True

    def forget(self) -> None:
        """Forget all but the static transforms: time has begun anew."""
        self._edges = {child: edge for child, edge in self._edges.items() if not edge.stamps}

    def lookup(self, target: str, source: str, stamp_ns: int) -> Float | None:
        """(4, 4) T_target_source; None: the frames are not connected, or not at this time."""
        up, down = self._path(source), self._path(target)
        common = next((name for name in up if name in down), None)
        if common is None:
            return None
        rising = self._compose(up[: up.index(common)], stamp_ns)
        falling = self._compose(down[: down.index(common)], stamp_ns)
        if rising is None or falling is None:
            return None
        return se2.inverse(falling) @ rising

    def begins_after(self, target: str, source: str, stamp_ns: int) -> bool:
        """True if the frames are connected, but are known for later times alone."""
        up = self._path(source)
        if target not in up:
            return False
        edges = (self._edges[child] for child in up[: up.index(target)])
        return any(edge.stamps and edge.stamps[0] > stamp_ns for edge in edges)

    def _path(self, child: str) -> list[str]:
        """A frame, its parent, and so on to the root."""
        path = [child]
        while (edge := self._edges.get(path[-1])) is not None and edge.parent not in path:
            path.append(edge.parent)
        return path

    def _compose(self, path: list[str], stamp_ns: int) -> Float | None:
        T = np.eye(4)
        for child in path:
            step = self._edges[child].at(stamp_ns)
            if step is None:
                return None
            T = step @ T
        return T


def to_plane(T: Float) -> Float:
    """(3, 3) the position and heading of a pose (4, 4) in space."""
    return se2.matrix(T[0, 3], T[1, 3], math.atan2(T[1, 0], T[0, 0]))


def _to_matrix(values: Float) -> Float:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(values[3:]).as_matrix()
    T[:3, 3] = values[:3]
    return T


def _is_pose(values: Sequence[float]) -> bool:
    # each by itself: max() of several, NaN among them, may return any of them
    near = all(abs(value) < MAX_TRANSLATION for value in values[:3])
    return near and abs(math.hypot(*values[3:]) - 1.0) < _NORM_TOLERANCE
