"""The transform tree (TF) of a bag, and odometry messages."""

import math
from array import array
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stillmap.core import se2
from stillmap.core.arrays import iter_blocks
from stillmap.io.builder import SkippedRecords
from stillmap.io.rigid_transforms import MAX_TRANSLATION
from stillmap.io.ros.messages import frame_name, stamp_ns

BAD_TRANSFORM = "transform that is none"

_NORM_TOLERANCE = 0.05  # of a quaternion
_BLOCK = 1 << 14  # poses interpolated at a time


class Lookup(NamedTuple):
    """Transforms at given times.

    Attributes:
        T: (N, 4, 4) float64.
        outside: number of times outside the known ones, which take the nearest transform.
        moves: whether the transform between the two frames varies.
    """

    T: NDArray[np.float64]
    outside: int
    moves: bool


class _Edge:
    """The transform from a frame to its parent over time."""

    def __init__(self, parent: str) -> None:
        self.parent = parent
        self.stamp_ns = array("q")
        self.values = array("d")  # x y z, quaternion x y z w
        self.constant = False

    def sorted_by_time(self) -> "_Edge":
        """Without duplicate stamps (the last one counts); constant if all values are equal."""
        stamps, values = np.asarray(self.stamp_ns, np.int64), np.asarray(self.values).reshape(-1, 7)
        order = np.argsort(stamps, kind="stable")
        stamps, values = stamps[order], values[order]
        last = np.append(stamps[1:] != stamps[:-1], True)
        out = _Edge(self.parent)
        out.stamp_ns = array("q", stamps[last].tolist())
        out.values = array("d", values[last].ravel())
        out.constant = self.constant or bool(np.all(values == values[0]))
        return out

    def interpolate(self, at_ns: NDArray[np.int64]) -> tuple[NDArray[np.float64], int]:
        """Transforms (N, 4, 4) at times (N,), and how many of these lie outside the known ones."""
        stamps, values = np.asarray(self.stamp_ns), np.asarray(self.values).reshape(-1, 7)
        if self.constant or len(stamps) == 1:
            outside = 0 if self.constant else int(np.count_nonzero(at_ns != stamps[0]))
            T = np.eye(4)
            T[:3, :3] = Rotation.from_quat(values[0, 3:]).as_matrix()
            T[:3, 3] = values[0, :3]
            return np.broadcast_to(T, (len(at_ns), 4, 4)), outside
        inside = np.clip(at_ns, stamps[0], stamps[-1])
        # relative to the first stamp: float64 does not hold nanoseconds since 1970
        known, wanted = (stamps - stamps[0]) / 1e9, (inside - stamps[0]) / 1e9
        T = np.tile(np.eye(4), (len(at_ns), 1, 1))
        for block in iter_blocks(wanted, rows=_BLOCK):
            T[block, :3, :3] = _interpolate_rotations(known, values[:, 3:], wanted[block])
        for axis in range(3):
            T[:, axis, 3] = np.interp(wanted, known, values[:, axis])
        return T, int(np.count_nonzero(inside != at_ns))


class TransformTree:
    """A forest of frames. Static transforms hold at all times."""

    def __init__(self) -> None:
        self.skipped = SkippedRecords()
        self._edges: dict[str, dict[str, _Edge]] = {}  # by child, by parent
        self._number = 0
        self._resolved: dict[str, _Edge] = {}

    def add_message(self, message: Any, *, static: bool) -> None:
        """Add the transforms of a TFMessage."""
        for transform in message.transforms:
            t, q = transform.transform.translation, transform.transform.rotation
            values = (t.x, t.y, t.z, q.x, q.y, q.z, q.w)
            parent = frame_name(transform.header.frame_id)
            child = frame_name(transform.child_frame_id)
            self.add_transform(parent, child, stamp_ns(transform.header), values, static=static)

    def add_transform(
        self, parent: str, child: str, stamp: int, values: tuple[float, ...], *, static: bool
    ) -> bool:
        """Add a transform: x y z in metres and a quaternion x y z w; an invalid one is counted."""
        self._number += 1
        if not (_is_pose(values) and child and parent and child != parent):
            self.skipped.add(BAD_TRANSFORM, self._number)
            return False
        edge = self._edges.setdefault(child, {}).setdefault(parent, _Edge(parent))
        if static:
            edge.constant = True
            edge.stamp_ns, edge.values = array("q", [stamp]), array("d", values)
        elif not edge.constant:
            edge.stamp_ns.append(stamp)
            edge.values.extend(values)
        self._resolved = {}
        return True

    @property
    def frames(self) -> set[str]:
        """All frames."""
        return set(self._edges) | {p for edges in self._edges.values() for p in edges}

    def parent(self, child: str) -> str | None:
        """The parent of a frame, None for a root."""
        edge = self._resolve().get(child)
        return None if edge is None else edge.parent

    def is_moving(self, child: str) -> bool:
        """True if a frame moves in its parent."""
        edge = self._resolve().get(child)
        return edge is not None and not edge.constant

    def path_to_root(self, child: str) -> list[str]:
        """A frame, its parent, and so on to the root."""
        path = [child]
        while (parent := self.parent(path[-1])) is not None and parent not in path:
            path.append(parent)
        return path

    def lookup(self, target: str, source: str, at_ns: NDArray[np.int64]) -> Lookup | None:
        """T_target_source at times (N,); None if the frames are not connected."""
        up, down = self.path_to_root(source), self.path_to_root(target)
        common = next((name for name in up if name in down), None)
        if common is None:
            return None
        rising, a, moves_a = self._compose(up[: up.index(common)], at_ns)
        falling, b, moves_b = self._compose(down[: down.index(common)], at_ns)
        return Lookup(se2.inverse(falling) @ rising, max(a, b), moves_a or moves_b)

    def stamps_between(self, target: str, source: str) -> NDArray[np.int64]:
        """Stamps of the moving frame between source and its ancestor target with fewest stamps."""
        up = self.path_to_root(source)
        end = up.index(target) if target in up else 0
        moving = [self._resolve()[child] for child in up[:end] if self.is_moving(child)]
        rarest = min(moving, key=lambda edge: len(edge.stamp_ns), default=None)
        return np.asarray(rarest.stamp_ns if rarest else [], np.int64)

    def _compose(
        self, path: list[str], at_ns: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], int, bool]:
        """Transforms (N, 4, 4) from the first frame of a path to the parent of its last."""
        T = np.broadcast_to(np.eye(4), (len(at_ns), 4, 4))
        outside, moves = 0, False
        for child in path:
            edge = self._resolve()[child]
            step, n_outside = edge.interpolate(at_ns)
            T, outside, moves = step @ T, max(outside, n_outside), moves or not edge.constant
        return T, outside, moves

    def _resolve(self) -> dict[str, _Edge]:
        """One parent per frame: a static one before others, else the most frequent."""
        if not self._resolved:
            for child, parents in self._edges.items():
                best = max(parents.values(), key=lambda e: (e.constant, len(e.stamp_ns)))
                self._resolved[child] = best.sorted_by_time()
        return self._resolved


class Odometry:
    """The poses of one Odometry topic: of frame `child` in `frame`."""

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.frame, self.child = "", ""
        self.stamp_ns = array("q")
        self._tree = TransformTree()
        self.skipped = self._tree.skipped

    def add_message(self, message: Any) -> None:
        """Add the pose of a message; an invalid one is counted."""
        p, q = message.pose.pose.position, message.pose.pose.orientation
        values = (p.x, p.y, p.z, q.x, q.y, q.z, q.w)
        stamp = stamp_ns(message.header)
        if self._tree.add_transform("odometry", "robot", stamp, values, static=False):
            self.frame = frame_name(message.header.frame_id)
            self.child = frame_name(message.child_frame_id)
            self.stamp_ns.append(stamp)

    def poses_at(self, at_ns: NDArray[np.int64]) -> Lookup:
        """T_frame_child at times (N,)."""
        found = self._tree.lookup("odometry", "robot", at_ns)
        assert found is not None
        return found


def _is_pose(values: tuple[float, ...]) -> bool:
    """True if x y z in metres and a quaternion x y z w are plausible."""
    # each by itself: max() of several, NaN among them, may return any of them
    near = all(abs(value) < MAX_TRANSLATION for value in values[:3])
    return near and abs(math.hypot(*values[3:]) - 1.0) < _NORM_TOLERANCE


def _interpolate_rotations(
    known: NDArray[np.float64], quaternions: NDArray[np.float64], wanted: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Rotations (n, 3, 3) at times (n,) on the shortest arcs between known ones (slerp)."""
    k = np.clip(np.searchsorted(known, wanted, side="right"), 1, len(known) - 1)
    share = (wanted - known[k - 1]) / (known[k] - known[k - 1])
    before, after = Rotation.from_quat(quaternions[k - 1]), Rotation.from_quat(quaternions[k])
    turn = Rotation.from_rotvec(share[:, None] * (before.inv() * after).as_rotvec())
    return np.asarray((before * turn).as_matrix(), np.float64)
