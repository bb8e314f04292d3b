"""Which frame is the robot, where its lasers sit on it, and where it was by its odometry."""

from array import array
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.io.builder import SkippedRecords
from stillmap.io.ros.messages import frame_name as frame_name
from stillmap.io.ros.messages import stamp_ns
from stillmap.io.ros.tf import BAD_TRANSFORM, TransformTree, is_pose
from stillmap.preprocessing.options import ReadOptions

SENSOR_IS_BASE = "the sensor is taken for the robot: nothing says where it sits on one"

_NAMES = ("base_link", "base_footprint", "base")
_GAP = 1.0  # s without odometry that is worth a word
_TILTED = 0.9  # cosine of the largest tilt of a laser whose scans are taken for level


class Odometry:
    """The messages of one Odometry topic: where a frame of the robot was."""

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.frame, self.child = "", ""
        self.stamp_ns = array("q")
        self.values = array("d")
        self.skipped = SkippedRecords()
        self._number = 0

    def add(self, message: Any) -> None:
        """Take in a message; a pose that is none is counted."""
        self._number += 1
        p, q = message.pose.pose.position, message.pose.pose.orientation
        values = (p.x, p.y, p.z, q.x, q.y, q.z, q.w)
        if not is_pose(values):
            self.skipped.add(BAD_TRANSFORM, self._number)
            return
        self.frame = frame_name(message.header.frame_id)
        self.child = frame_name(message.child_frame_id)
        self.stamp_ns.append(stamp_ns(message.header))
        self.values.extend(values)


class SensorPoses(NamedTuple):
    """Where sensors are on the robot.

    Attributes:
        base: the frame of the robot.
        how: why that one, in words.
        T_base_sensor: for each frame that was asked for (N, 4, 4) at its scans; None where a
            frame does not hang together with the base.
        moves: for each whether it moves on the robot.
    """

    base: str
    how: str
    T_base_sensor: list[NDArray[np.float64] | None]
    moves: list[bool]


def find_base_frame(
    transforms: TransformTree, sensors: list[str], odometry: list[Odometry], options: ReadOptions
) -> tuple[str, str]:
    """The frame of the robot, and how it was found.

    Raises:
        InputError: the options name a frame that is not there.
    """
    given = options.base_frame
    if given is not None:
        if given not in transforms.frames and given not in sensors:
            known = ", ".join(sorted(transforms.frames | set(sensors))[:20])
            raise InputError(f"base frame {given!r} is not in the recording", hint=f"has: {known}")
        return given, "given"
    path = transforms.path_to_root(sensors[0])
    for one in odometry:
        if one.child and one.child in path:
            return one.child, f"{one.topic} names it"
    for name in _NAMES:
        found = [above for above in path[1:] if above.rpartition("/")[2] == name]
        if found:
            return found[0], "by its name"
    for below in path:
        if transforms.is_moving(below):
            if below == sensors[0]:
                break
            return below, f"it moves in {transforms.parent(below)}"
    if len(path) > 1 and not any(map(transforms.is_moving, path)):
        return path[-1], "all frames hang on it"
    return sensors[0], SENSOR_IS_BASE


def find_sensor_poses(
    transforms: TransformTree, base: tuple[str, str], sensors: list[tuple[str, NDArray[np.int64]]]
) -> SensorPoses:
    """Where sensors sit on the robot, each at its own times (N,)."""
    found, moves = [], []
    for name, at_ns in sensors:
        located = transforms.lookup(base[0], name, at_ns)
        found.append(None if located is None else located.T)
        moves.append(located is not None and located.moves)
    return SensorPoses(*base, found, moves)


def base_frame_warnings(placed: SensorPoses) -> list[str]:
    """A warning where the robot's frame is a makeshift."""
    if placed.how != SENSOR_IS_BASE:
        return []
    return [f"no transform says where {placed.base!r} sits on a robot: took the laser as the base"]


def project_to_plane(T: NDArray[np.float64]) -> tuple[NDArray[np.float64], bool, bool]:
    """A level laser seen from above: (N, 3, 3), whether it hangs upside down, whether it tilts."""
    up = T[:, 2, 2]
    theta = np.arctan2(T[:, 1, 0], T[:, 0, 0])
    flat = se2.matrix(T[:, 0, 3], T[:, 1, 3], theta)
    return flat, bool(np.median(up) < 0.0), bool(np.any(np.abs(up) < _TILTED))


def find_odometry(
    transforms: TransformTree,
    base: str,
    odometry: list[Odometry],
    at_ns: NDArray[np.int64],
    options: ReadOptions,
) -> tuple[NDArray[np.float64] | None, dict[str, Any], list[str]]:
    """Odometry (T, 4, 4) at the scans, where it is from (for `source`), and warnings in words.

    Raises:
        InputError: the options name a frame that is not there.
    """
    frame = options.odom_frame
    if frame is not None and frame not in transforms.frames | {o.frame for o in odometry}:
        raise InputError(f"odometry frame {frame!r} is not in the recording")
    named = _find_odom_frame(transforms, base) if frame is None else frame
    if named in transforms.frames:
        found = transforms.lookup(named, base, at_ns)
        if found is not None and found.moves:
            gap = _largest_gap(transforms.stamps_between(named, base), at_ns)
            return found.T, *_describe_odometry(f"TF from {named} to {base}", found.outside, gap)
    for one in sorted(odometry, key=lambda o: -len(o.stamp_ns)):
        if frame in (None, one.frame) and len(one.stamp_ns):
            return _odometry_from_topic(one, transforms, base, at_ns)
    return None, {"from": None, "outside": 0}, []


def _odometry_from_topic(
    one: Odometry, transforms: TransformTree, base: str, at_ns: NDArray[np.int64]
) -> tuple[NDArray[np.float64], dict[str, Any], list[str]]:
    alone = TransformTree()
    stamps = list(one.stamp_ns)
    for stamp, values in zip(stamps, np.asarray(one.values).reshape(-1, 7).tolist(), strict=True):
        alone.add_transform("odometry", "robot", stamp, tuple(values), static=False)
    found = alone.lookup("odometry", "robot", at_ns)
    assert found is not None
    T, more = found.T, []
    on_robot = transforms.lookup(one.child, base, at_ns) if one.child != base else None
    if on_robot is not None:
        T = T @ on_robot.T
    elif one.child not in ("", base):
        more = [f"{one.topic}: taken for {base}, though it speaks of {one.child}"]
    told, warnings = _describe_odometry(
        one.topic, found.outside, _largest_gap(np.array(stamps), at_ns)
    )
    return T, told, more + warnings


def _find_odom_frame(transforms: TransformTree, base: str) -> str:
    """The frame in which the robot moves first, on the way up."""
    for name in transforms.path_to_root(base):
        above = transforms.parent(name)
        if above is not None and transforms.is_moving(name):
            return above
    return ""


def _largest_gap(stamps: NDArray[np.int64], at_ns: NDArray[np.int64]) -> float:
    """s: the longest time without odometry during the scans."""
    stamps = np.sort(stamps)
    if not len(at_ns) or not len(stamps):
        return 0.0
    stamps = stamps[(stamps >= at_ns[0]) & (stamps <= at_ns[-1])]
    return float(np.diff(stamps).max(initial=0)) / 1e9


def _describe_odometry(origin: str, outside: int, gap: float) -> tuple[dict[str, Any], list[str]]:
    warnings = []
    if outside:
        warnings.append(f"{outside} scans outside the time of the odometry: nearest pose")
    if gap > _GAP:
        warnings.append(f"no odometry for {gap:.1f} s: interpolated over the gap")
    return {"from": origin, "outside": outside}, warnings
