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
from stillmap.core.timestamps import order_in_time
from stillmap.io.builder import SkippedRecords
from stillmap.io.ros.messages import frame_name, stamp_ns
from stillmap.io.trajectory import MAX_TRANSLATION, describe_odometry, poses_from_rows
from stillmap.prepare.options import ReadOptions

BAD_TRANSFORM = "transform that is none"
SENSOR_IS_BASE = "the sensor's frame: no transform gives its pose on a robot"

_NORM_TOLERANCE = 0.05  # of a quaternion
_BLOCK = 1 << 14  # poses interpolated at a time
_BASE_NAMES = ("base_link", "base_footprint", "base")
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


class Motion:
    """The transform from a frame to its parent over time.

    Attributes:
        stamp_ns: of each transform.
        values: x y z, quaternion x y z w of each.
        constant: it is the same at all times.
    """

    def __init__(self) -> None:
        self.stamp_ns, self.values, self.constant = array("q"), array("d"), False

    def add(self, stamp: int, t: Any, q: Any) -> bool:
        """Add a translation in metres and a quaternion; False if they are invalid."""
        values = (t.x, t.y, t.z, q.x, q.y, q.z, q.w)
        # each by itself: max() of several, NaN among them, may return any of them
        near = all(abs(value) < MAX_TRANSLATION for value in values[:3])
        if not near or not abs(math.hypot(*values[3:]) - 1.0) < _NORM_TOLERANCE:
            return False
        self.stamp_ns.append(stamp)
        self.values.extend(values)
        return True

    def sort(self) -> None:
        """Order in time, without duplicate stamps (the last one counts); note that it is constant
        if all values are equal."""
        order = order_in_time(np.asarray(self.stamp_ns, np.int64))
        stamps = np.asarray(self.stamp_ns, np.int64)[order]
        values = np.asarray(self.values).reshape(-1, 7)[order]
        last = len(stamps) - 1 - np.unique(stamps[::-1], return_index=True)[1]
        self.constant = self.constant or bool(np.all(values == values[last[0]]))
        self.stamp_ns = array("q", stamps[last].tolist())
        self.values = array("d", values[last].ravel())

    def interpolate(self, at_ns: Int64) -> tuple[Float, int]:
        """Transforms (N, 4, 4) at times (N,), and how many of these lie outside the known ones."""
        stamps, values = np.asarray(self.stamp_ns), np.asarray(self.values).reshape(-1, 7)
        if self.constant or len(stamps) == 1:
            outside = 0 if self.constant else int(np.count_nonzero(at_ns != stamps[0]))
            return np.broadcast_to(poses_from_rows(values[:1]), (len(at_ns), 4, 4)), outside
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
    """A forest of frames. Static transforms hold at all times.

    Attributes:
        skipped: transforms that are none.
        odometry: of each Odometry topic.
    """

    def __init__(self) -> None:
        self.skipped = SkippedRecords()
        self.odometry: dict[str, Odometry] = {}
        self._motions: dict[str, dict[str, Motion]] = {}  # by child, by parent
        self._number = 0
        self._resolved: dict[str, tuple[str, Motion]] = {}

    def add_message(self, message: Any, *, static: bool) -> None:
        """Add the transforms of a TFMessage; invalid ones are counted."""
        for one in message.transforms:
            parent, child = frame_name(one.header.frame_id), frame_name(one.child_frame_id)
            t, q, stamp = one.transform.translation, one.transform.rotation, stamp_ns(one.header)
            self._number += 1
            given = Motion()
            if not (given.add(stamp, t, q) and child and parent and child != parent):
                self.skipped.add(BAD_TRANSFORM, self._number)
                continue
            motions = self._motions.setdefault(child, {})
            known = motions.setdefault(parent, given)
            if static:
                motions[parent], given.constant = given, True
            elif known is not given and not known.constant:
                known.add(stamp, t, q)
            self._resolved = {}

    @property
    def frames(self) -> set[str]:
        """All frames."""
        return set(self._motions) | {p for motions in self._motions.values() for p in motions}

    def parent(self, child: str) -> str | None:
        """The parent of a frame, None for a root."""
        return self._resolve().get(child, (None,))[0]

    def is_moving(self, child: str) -> bool:
        """True if a frame moves in its parent."""
        return child in self._resolve() and not self._resolve()[child][1].constant

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
        moving = [self._resolve()[child][1] for child in up[:end] if self.is_moving(child)]
        rarest = min(moving, key=lambda motion: len(motion.stamp_ns), default=Motion())
        return np.asarray(rarest.stamp_ns, np.int64)

    def _compose(self, path: list[str], at_ns: Int64) -> Lookup:
        """Transforms from the first frame of a path to the parent of its last."""
        T = np.broadcast_to(np.eye(4), (len(at_ns), 4, 4))
        outside, moves = 0, False
        for child in path:
            motion = self._resolve()[child][1]
            step, n_outside = motion.interpolate(at_ns)
            T, outside, moves = step @ T, max(outside, n_outside), moves or not motion.constant
        return Lookup(T, outside, moves)

    def _resolve(self) -> dict[str, tuple[str, Motion]]:
        """One parent per frame: a static one before others, else the most frequent."""
        if not self._resolved:
            for child, parents in self._motions.items():
                of_parent = max(parents.items(), key=lambda p: (p[1].constant, len(p[1].stamp_ns)))
                of_parent[1].sort()
                self._resolved[child] = of_parent
        return self._resolved


def _interpolate_rotations(known: Float, quaternions: Float, wanted: Float) -> Float:
    """Rotations (n, 3, 3) at times (n,) on the shortest arcs between known ones (slerp)."""
    k = np.clip(np.searchsorted(known, wanted, side="right"), 1, len(known) - 1)
    share = (wanted - known[k - 1]) / (known[k] - known[k - 1])
    before, after = Rotation.from_quat(quaternions[k - 1]), Rotation.from_quat(quaternions[k])
    turn = Rotation.from_rotvec(share[:, None] * (before.inv() * after).as_rotvec())
    return np.asarray((before * turn).as_matrix(), np.float64)


class Odometry(Motion):
    """The poses of one Odometry topic: of frame `child` in `frame`."""

    def __init__(self, topic: str) -> None:
        super().__init__()
        self.topic, self.frame, self.child = topic, "", ""
        self.skipped, self._number = SkippedRecords(), 0

    def add_message(self, message: Any) -> None:
        """Add the pose of a message; an invalid one is counted."""
        pose = message.pose.pose
        self._number += 1
        if self.add(stamp_ns(message.header), pose.position, pose.orientation):
            self.frame = frame_name(message.header.frame_id)
            self.child = frame_name(message.child_frame_id)
        else:
            self.skipped.add(BAD_TRANSFORM, self._number)


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


def place_sensors(tree: TransformTree, sensors: list[Sensor], options: ReadOptions) -> SensorPoses:
    """Find the base frame and the poses of sensors in it, which are in order of preference.

    Of topics in the same frame the first is used, and only those connected with the base.

    Raises:
        InputError: the options name a frame that is not there, or a topic that cannot be used.
    """
    kept, omitted = _drop_duplicates(sensors, named=options.topic is not None)
    base, how = _find_base_frame(tree, [sensors[k].frame for k in kept], options)
    used: list[int] = []
    T_base_sensor = []
    for k in kept:
        sensor = sensors[k]
        pose = tree.lookup(base, sensor.frame, sensor.stamp_ns)
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


def _find_base_frame(
    tree: TransformTree, sensors: list[str], options: ReadOptions
) -> tuple[str, str]:
    """The base frame, and how it was found."""
    given = options.base_frame
    if given is not None:
        if given not in tree.frames and given not in sensors:
            known = ", ".join(sorted(tree.frames | set(sensors))[:20])
            raise InputError(f"base frame {given!r} is not in the recording", hint=f"has: {known}")
        return given, "given"
    path = tree.path_to_root(sensors[0])
    for topic in tree.odometry.values():
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
    tilts = bool(np.any(np.abs(up) < _MIN_UPRIGHT))
    return se2.project_to_plane(T), bool(np.median(up) < 0.0), tilts


def find_odometry(
    tree: TransformTree, base: str, at_ns: Int64, options: ReadOptions, warnings: list[str]
) -> tuple[Float | None, dict[str, Any]]:
    """Odometry (T, 4, 4) at the scans, and its origin (for `source`); adds warnings.

    Transforms to a frame in which the base moves come first, then Odometry topics.

    Raises:
        InputError: the options name a frame that is not there.
    """
    odometry, frame = tree.odometry.values(), options.odom_frame
    if frame is not None and frame not in tree.frames | {o.frame for o in odometry}:
        raise InputError(f"odometry frame {frame!r} is not in the recording")
    # the nearest frame above the base in which it moves
    moving = [name for name in tree.path_to_root(base) if tree.is_moving(name)]
    odom = frame or (tree.parent(moving[0]) if moving else None) or ""
    poses = tree.lookup(odom, base, at_ns) if odom in tree.frames else None
    if poses is not None and poses.moves:
        origin = f"TF from {odom} to {base}"
        return poses.T, describe_odometry(origin, poses.outside, warnings)
    for topic in sorted(odometry, key=lambda o: -len(o.stamp_ns)):
        if frame in (None, topic.frame):
            topic.sort()
            (T, outside), T_child_base = topic.interpolate(at_ns), None
            if topic.child != base:
                T_child_base = tree.lookup(topic.child, base, at_ns)
            if T_child_base is None and topic.child not in ("", base):
                text = f"used as the pose of {base}, although it is of {topic.child}"
                warnings.append(f"{topic.topic}: {text}")
            T = T if T_child_base is None else T @ T_child_base.T
            return T, describe_odometry(topic.topic, outside, warnings)
    return None, describe_odometry(None, 0, warnings)
