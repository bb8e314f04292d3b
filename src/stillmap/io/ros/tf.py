"""The transform tree (TF) of a bag, odometry messages, and the robot's base frame."""

import math
from array import array
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from stillmap.core import se2
from stillmap.core.array_types import Float, Int64
from stillmap.core.arrays import iter_blocks
from stillmap.core.errors import InputError
from stillmap.io.builder import SkippedRecords
from stillmap.io.ros.messages import frame_name, stamp_ns
from stillmap.io.trajectory import MAX_TRANSLATION
from stillmap.prepare.options import ReadOptions

SENSOR_IS_BASE = "the sensor's frame: no transform gives its pose on a robot"

_NORM_TOLERANCE = 0.05  # of a quaternion
_BLOCK = 1 << 14  # poses interpolated at a time
_BASE_NAMES = ("base_link", "base_footprint", "base")
_MAX_GAP = 1.0  # s without odometry before a warning
_MIN_UPRIGHT = 0.9  # cosine of the largest tilt of a laser that counts as level
_MIN_SHARE = 0.25  # of the most frequent sensor's scans: rarer topics are no sensors of their own


class Lookup(NamedTuple):
    """Transforms at given times.

    Attributes:
        T: (N, 4, 4) float64.
        outside: number of times outside the known ones, which take the nearest transform.
        moves: whether the transform between the two frames varies.
    """

    T: Float
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
        last = len(stamps) - 1 - np.unique(stamps[::-1], return_index=True)[1]
        out = _Edge(self.parent)
        out.stamp_ns = array("q", stamps[last].tolist())
        out.values = array("d", values[last].ravel())
        out.constant = self.constant or bool(np.all(values == values[last[0]]))
        return out

    def interpolate(self, at_ns: Int64) -> tuple[Float, int]:
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
        for one in message.transforms:
            parent, child = frame_name(one.header.frame_id), frame_name(one.child_frame_id)
            t, q = one.transform.translation, one.transform.rotation
            self.add_transform(parent, child, stamp_ns(one.header), t, q, static=static)

    def add_transform(
        self, parent: str, child: str, stamp: int, t: Any, q: Any, *, static: bool = False
    ) -> bool:
        """Add a transform: a translation in metres and a quaternion; an invalid one is counted."""
        self._number += 1
        values = (t.x, t.y, t.z, q.x, q.y, q.z, q.w)
        # each by itself: max() of several, NaN among them, may return any of them
        near = all(abs(value) < MAX_TRANSLATION for value in values[:3])
        is_pose = near and abs(math.hypot(*values[3:]) - 1.0) < _NORM_TOLERANCE
        if not (is_pose and child and parent and child != parent):
            self.skipped.add("transform that is none", self._number)
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

    def lookup(self, target: str, source: str, at_ns: Int64) -> Lookup | None:
        """T_target_source at times (N,); None if the frames are not connected."""
        up, down = self.path_to_root(source), self.path_to_root(target)
        common = next((name for name in up if name in down), None)
        if common is None:
            return None
        rising = self._compose(up[: up.index(common)], at_ns)
        falling = self._compose(down[: down.index(common)], at_ns)
        T = se2.inverse(falling.T) @ rising.T
        moves = rising.moves or falling.moves
        return Lookup(T, max(rising.outside, falling.outside), moves)

    def stamps_between(self, target: str, source: str) -> Int64:
        """Int64 of the moving frame between source and its ancestor target with fewest stamps."""
        up = self.path_to_root(source)
        end = up.index(target) if target in up else 0
        moving = [self._resolve()[child] for child in up[:end] if self.is_moving(child)]
        rarest = min(moving, key=lambda edge: len(edge.stamp_ns), default=None)
        return np.asarray(rarest.stamp_ns if rarest else [], np.int64)

    def _compose(self, path: list[str], at_ns: Int64) -> Lookup:
        """Transforms from the first frame of a path to the parent of its last."""
        T = np.broadcast_to(np.eye(4), (len(at_ns), 4, 4))
        outside, moves = 0, False
        for child in path:
            edge = self._resolve()[child]
            step, n_outside = edge.interpolate(at_ns)
            T, outside, moves = step @ T, max(outside, n_outside), moves or not edge.constant
        return Lookup(T, outside, moves)

    def _resolve(self) -> dict[str, _Edge]:
        """One parent per frame: a static one before others, else the most frequent."""
        if not self._resolved:
            for child, parents in self._edges.items():
                best = max(parents.values(), key=lambda e: (e.constant, len(e.stamp_ns)))
                self._resolved[child] = best.sorted_by_time()
        return self._resolved


def _interpolate_rotations(known: Float, quaternions: Float, wanted: Float) -> Float:
    """Rotations (n, 3, 3) at times (n,) on the shortest arcs between known ones (slerp)."""
    k = np.clip(np.searchsorted(known, wanted, side="right"), 1, len(known) - 1)
    share = (wanted - known[k - 1]) / (known[k] - known[k - 1])
    before, after = Rotation.from_quat(quaternions[k - 1]), Rotation.from_quat(quaternions[k])
    turn = Rotation.from_rotvec(share[:, None] * (before.inv() * after).as_rotvec())
    return np.asarray((before * turn).as_matrix(), np.float64)


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
        pose, stamp = message.pose.pose, stamp_ns(message.header)
        if self._tree.add_transform("odometry", "robot", stamp, pose.position, pose.orientation):
            self.frame = frame_name(message.header.frame_id)
            self.child = frame_name(message.child_frame_id)
            self.stamp_ns.append(stamp)

    def poses_at(self, at_ns: Int64) -> Lookup:
        """T_frame_child at times (N,)."""
        poses = self._tree.lookup("odometry", "robot", at_ns)
        assert poses is not None
        return poses


class Frames(NamedTuple):
    """The transforms of a bag, and its Odometry topics with at least one pose."""

    tree: TransformTree
    odometry: list[Odometry]


class Sensor(NamedTuple):
    """A topic of scans: its frame, and the stamps (N,) of the scans."""

    topic: str
    frame: str
    stamp_ns: Int64


class SensorPoses(NamedTuple):
    """Poses of sensors on the robot.

    Attributes:
        base: base frame.
        how: how it was found.
        used: indices of the sensors that are used.
        T_base_sensor: of each of these (N, 4, 4) at its scans.
        omitted: sentences on the others.
        warnings: sentences.
    """

    base: str
    how: str
    used: list[int]
    T_base_sensor: list[Float]
    omitted: list[str]
    warnings: list[str]


def place_sensors(frames: Frames, sensors: list[Sensor], options: ReadOptions) -> SensorPoses:
    """Find the base frame and the poses of sensors in it, which are in order of preference.

    Of topics in the same frame the first is used, and only those connected with the base.

    Raises:
        InputError: the options name a frame that is not there, or a topic that cannot be used.
    """
    kept, omitted = _drop_duplicates(sensors, named=options.topic is not None)
    base, how = _find_base_frame(frames, [sensors[k].frame for k in kept], options)
    used: list[int] = []
    T_base_sensor = []
    for k in kept:
        sensor = sensors[k]
        pose = frames.tree.lookup(base, sensor.frame, sensor.stamp_ns)
        if pose is None and options.base_frame is not None and not used:
            raise InputError(f"no transform connects {sensor.frame!r} with {base!r}")
        if pose is None and used:
            text = f"no transform connects {sensor.frame!r} with {sensors[used[0]].frame!r}"
            hint = f"read.topic = {sensor.topic!r} takes it instead"
            omitted.append(f"{sensor.topic}: {len(sensor.stamp_ns)} scans, {text} ({hint})")
            continue
        used.append(k)
        unknown = np.tile(np.eye(4), (len(sensor.stamp_ns), 1, 1))
        T_base_sensor.append(unknown if pose is None else pose.T)
    named = {name.strip().removeprefix("/") for name in (options.topic or "").split(",")}
    for text in omitted:
        topic, _, why = text.partition(": ")
        if topic.removeprefix("/") in named - {sensors[k].topic.removeprefix("/") for k in used}:
            others = " and ".join(sensors[k].topic for k in used)
            raise InputError(f"topic {topic!r} cannot be used with {others}: {why}")
    warning = f"no transform gives the pose of {base!r} on a robot: it is used as the base frame"
    return SensorPoses(base, how, used, T_base_sensor, omitted, [warning] * (how == SENSOR_IS_BASE))


def _drop_duplicates(sensors: list[Sensor], *, named: bool) -> tuple[list[int], list[str]]:
    """Indices of one topic per frame, and sentences on the others.

    Unless the user `named` the topics, those with few scans are dropped too.
    """
    most = max(len(sensor.stamp_ns) for sensor in sensors)
    used: dict[str, int] = {}  # by frame
    dropped = []
    for k, (topic, frame, stamps) in enumerate(sensors):
        scans = f"{topic}: {len(stamps)} scans"
        if frame in used:
            dropped.append(f"{scans}, {sensors[used[frame]].topic} shows the same sensor")
        elif not named and len(stamps) < _MIN_SHARE * most:
            dropped.append(f"{scans} are too few")
        else:
            used[frame] = k
    return list(used.values()), dropped


def _find_base_frame(frames: Frames, sensors: list[str], options: ReadOptions) -> tuple[str, str]:
    """The base frame, and how it was found."""
    tree, given = frames.tree, options.base_frame
    if given is not None:
        if given not in tree.frames and given not in sensors:
            known = ", ".join(sorted(tree.frames | set(sensors))[:20])
            raise InputError(f"base frame {given!r} is not in the recording", hint=f"has: {known}")
        return given, "given"
    path = tree.path_to_root(sensors[0])
    for topic in frames.odometry:
        if topic.child and topic.child in path:
            return topic.child, f"{topic.topic} names it"
    for name in _BASE_NAMES:
        for above in path[1:]:
            if above.rpartition("/")[2] == name:
                return above, "by its name"
    lowest = next((frame for frame in path if tree.is_moving(frame)), None)
    if lowest is not None and lowest != sensors[0]:
        return lowest, f"it moves in {tree.parent(lowest)}"
    if lowest is None and len(path) > 1:
        return path[-1], "all frames hang on it"
    return sensors[0], SENSOR_IS_BASE


def project_to_plane(T: Float) -> tuple[Float, bool, bool]:
    """2D poses (N, 3, 3) of a laser, whether it is mounted upside down, whether it is tilted."""
    up = T[:, 2, 2]
    theta = np.arctan2(T[:, 1, 0], T[:, 0, 0])
    flat = se2.matrix(T[:, 0, 3], T[:, 1, 3], theta)
    return flat, bool(np.median(up) < 0.0), bool(np.any(np.abs(up) < _MIN_UPRIGHT))


def find_odometry(
    frames: Frames, base: str, at_ns: Int64, options: ReadOptions, warnings: list[str]
) -> tuple[Float | None, dict[str, Any]]:
    """Odometry (T, 4, 4) at the scans, and its origin (for `source`); adds warnings.

    Transforms to a frame in which the base moves come first, then Odometry topics.

    Raises:
        InputError: the options name a frame that is not there.
    """
    (tree, odometry), frame = frames, options.odom_frame
    if frame is not None and frame not in tree.frames | {o.frame for o in odometry}:
        raise InputError(f"odometry frame {frame!r} is not in the recording")
    # the nearest frame above the base in which it moves
    moving = [name for name in tree.path_to_root(base) if tree.is_moving(name)]
    odom = frame or (tree.parent(moving[0]) if moving else None) or ""
    poses = tree.lookup(odom, base, at_ns) if odom in tree.frames else None
    if poses is not None and poses.moves:
        _warn_of_gaps(poses.outside, tree.stamps_between(odom, base), at_ns, warnings)
        return poses.T, {"from": f"TF from {odom} to {base}", "outside": poses.outside}
    for topic in sorted(odometry, key=lambda o: -len(o.stamp_ns)):
        if frame in (None, topic.frame):
            poses, T_child_base = topic.poses_at(at_ns), None
            if topic.child != base:
                T_child_base = tree.lookup(topic.child, base, at_ns)
            if T_child_base is None and topic.child not in ("", base):
                text = f"used as the pose of {base}, although it is of {topic.child}"
                warnings.append(f"{topic.topic}: {text}")
            _warn_of_gaps(poses.outside, np.asarray(topic.stamp_ns), at_ns, warnings)
            T = poses.T if T_child_base is None else poses.T @ T_child_base.T
            return T, {"from": topic.topic, "outside": poses.outside}
    return None, {"from": None, "outside": 0}


def _warn_of_gaps(outside: int, stamps: Int64, at_ns: Int64, warnings: list[str]) -> None:
    """Warn of scans at times (T,) outside odometry of these stamps, or in a gap of it."""
    if outside:
        warnings.append(f"{outside} scans outside the time of the odometry: nearest pose")
    if not len(at_ns) or not len(stamps):
        return
    stamps = np.sort(stamps)
    stamps = stamps[(stamps >= at_ns[0]) & (stamps <= at_ns[-1])]
    gap = float(np.diff(stamps).max(initial=0)) / 1e9
    if gap > _MAX_GAP:
        warnings.append(f"no odometry for {gap:.1f} s: interpolated over the gap")
