"""Frames and the transforms between them, from TF messages."""

import math
from array import array
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stillmap.core import se2
from stillmap.core.arrays import iter_blocks
from stillmap.io.builder import SkippedRecords
from stillmap.io.ros.messages import frame_name, stamp_ns

BAD_TRANSFORM = "transform that is none"

_UNIT = 0.05  # a quaternion's length may be off by this much
_LARGEST = 1e9  # m
_TOGETHER = 1 << 14  # poses that are interpolated together


def is_pose(values: tuple[float, ...]) -> bool:
    """Whether x y z in metres and a quaternion x y z w can be where something is."""
    # each number by itself: the largest of a few, NaN among them, may be any of them
    near = all(abs(value) < _LARGEST for value in values[:3])
    return near and abs(math.hypot(*values[3:]) - 1.0) < _UNIT


class _Edge:
    """How one frame lies in its parent, over time."""

    def __init__(self, parent: str) -> None:
        self.parent = parent
        self.stamp_ns = array("q")
        self.values = array("d")  # x y z, quaternion x y z w
        self.constant = False


class Lookup(NamedTuple):
    """Transforms at given times.

    Attributes:
        T: (N, 4, 4) float64.
        outside: how many of the times lie outside what is known: those take the nearest.
        moves: whether anything between the two frames changes over time.
    """

    T: NDArray[np.float64]
    outside: int
    moves: bool


class TransformTree:
    """A forest of frames. Transforms that never change hold for all times."""

    def __init__(self) -> None:
        self._edges: dict[str, dict[str, _Edge]] = {}  # by child, by parent
        self.skipped = SkippedRecords()
        self._number = 0
        self._final: dict[str, _Edge] = {}

    def add_message(self, message: Any, *, static: bool) -> None:
        """Take in a TFMessage."""
        for transform in message.transforms:
            self._number += 1
            t, q = transform.transform.translation, transform.transform.rotation
            values = (t.x, t.y, t.z, q.x, q.y, q.z, q.w)
            parent, child = (
                frame_name(transform.header.frame_id),
                frame_name(transform.child_frame_id),
            )
            self.add_transform(parent, child, stamp_ns(transform.header), values, static=static)

    def add_transform(
        self, parent: str, child: str, stamp: int, values: tuple[float, ...], *, static: bool
    ) -> None:
        """One transform: x y z in metres and a quaternion x y z w."""
        if not (is_pose(values) and child and parent and child != parent):
            self.skipped.add(BAD_TRANSFORM, self._number)
            return
        edge = self._edges.setdefault(child, {}).setdefault(parent, _Edge(parent))
        if static:
            edge.constant = True
            edge.stamp_ns, edge.values = array("q", [stamp]), array("d", values)
        elif not edge.constant:
            edge.stamp_ns.append(stamp)
            edge.values.extend(values)
        self._final = {}

    @property
    def frames(self) -> set[str]:
        """Every frame that is named."""
        return set(self._edges) | {p for edges in self._edges.values() for p in edges}

    def parent(self, child: str) -> str | None:
        """The frame that a frame hangs on, None for a root."""
        edge = self._settled().get(child)
        return None if edge is None else edge.parent

    def is_moving(self, child: str) -> bool:
        """Whether a frame moves in its parent."""
        edge = self._settled().get(child)
        return edge is not None and not edge.constant

    def path_to_root(self, child: str) -> list[str]:
        """A frame, its parent, and so on to the root."""
        path = [child]
        while (above := self.parent(path[-1])) is not None and above not in path:
            path.append(above)
        return path

    def lookup(self, target: str, source: str, at_ns: NDArray[np.int64]) -> Lookup | None:
        """Where `source` lies in `target` at times (N,); None if they do not hang together."""
        up, down = self.path_to_root(source), self.path_to_root(target)
        meet = next((name for name in up if name in down), None)
        if meet is None:
            return None
        rising, a, moves_a = self._along(up[: up.index(meet)], at_ns)
        falling, b, moves_b = self._along(down[: down.index(meet)], at_ns)
        return Lookup(se2.inverse(falling) @ rising, max(a, b), moves_a or moves_b)

    def stamps_between(self, target: str, source: str) -> NDArray[np.int64]:
        """Times at which the slowest told of the moving frames on the way up was told."""
        up = self.path_to_root(source)
        end = up.index(target) if target in up else 0
        moving = [self._settled()[child] for child in up[:end] if self.is_moving(child)]
        rarest = min(moving, key=lambda edge: len(edge.stamp_ns), default=None)
        return np.asarray(rarest.stamp_ns if rarest else [], np.int64)

    def _along(
        self, path: list[str], at_ns: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], int, bool]:
        """Transforms (N, 4, 4) from the first frame of a path to the parent of its last."""
        T = np.broadcast_to(np.eye(4), (len(at_ns), 4, 4))
        outside, moves = 0, False
        for child in path:
            edge = self._settled()[child]
            step, missed = _interpolate(edge, at_ns)
            T, outside, moves = step @ T, max(outside, missed), moves or not edge.constant
        return T, outside, moves

    def _settled(self) -> dict[str, _Edge]:
        """One parent per frame: the one told most often, a constant one before others."""
        if not self._final and self._edges:
            for child, parents in self._edges.items():
                best = max(parents.values(), key=lambda e: (e.constant, len(e.stamp_ns)))
                self._final[child] = _sort_by_time(best)
        return self._final


def _sort_by_time(edge: _Edge) -> _Edge:
    """By time, one transform per time (the last one told); constant if it never changes."""
    stamps = np.asarray(edge.stamp_ns, np.int64)
    values = np.asarray(edge.values).reshape(-1, 7)
    order = np.argsort(stamps, kind="stable")
    stamps, values = stamps[order], values[order]
    last = np.append(stamps[1:] != stamps[:-1], True)
    out = _Edge(edge.parent)
    out.stamp_ns, out.values = array("q", stamps[last].tolist()), array("d", values[last].ravel())
    out.constant = edge.constant or bool(np.all(values == values[0]))
    return out


def _interpolate_rotations(
    known: NDArray[np.float64], quaternions: NDArray[np.float64], wanted: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Rotations (n, 3, 3) at times (n,) between those that are known, by the shortest turn."""
    k = np.clip(np.searchsorted(known, wanted, side="right"), 1, len(known) - 1)
    share = (wanted - known[k - 1]) / (known[k] - known[k - 1])
    before, after = Rotation.from_quat(quaternions[k - 1]), Rotation.from_quat(quaternions[k])
    turn = Rotation.from_rotvec(share[:, None] * (before.inv() * after).as_rotvec())
    return np.asarray((before * turn).as_matrix(), np.float64)


def _interpolate(edge: _Edge, at_ns: NDArray[np.int64]) -> tuple[NDArray[np.float64], int]:
    """Transforms (N, 4, 4) at times (N,), and how many of these are outside the edge's own."""
    stamps, values = np.asarray(edge.stamp_ns), np.asarray(edge.values).reshape(-1, 7)
    if edge.constant or len(stamps) == 1:
        missed = 0 if edge.constant else int(np.count_nonzero(at_ns != stamps[0]))
        return np.broadcast_to(_matrices(values[:1]), (len(at_ns), 4, 4)), missed
    inside = np.clip(at_ns, stamps[0], stamps[-1])
    # seconds since the first: nanoseconds since 1970 are no exact floating point numbers
    known, wanted = (stamps - stamps[0]) / 1e9, (inside - stamps[0]) / 1e9
    T = np.tile(np.eye(4), (len(at_ns), 1, 1))
    for block in iter_blocks(wanted, rows=_TOGETHER):
        T[block, :3, :3] = _interpolate_rotations(known, values[:, 3:], wanted[block])
    for axis in range(3):
        T[:, axis, 3] = np.interp(wanted, known, values[:, axis])
    return T, int(np.count_nonzero(inside != at_ns))


def _matrices(values: NDArray[np.float64]) -> NDArray[np.float64]:
    T = np.tile(np.eye(4), (len(values), 1, 1))
    T[:, :3, :3] = Rotation.from_quat(values[:, 3:]).as_matrix()
    T[:, :3, 3] = values[:, :3]
    return T
