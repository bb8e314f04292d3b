"""Which frame is the robot, where its lasers sit on it, and where it was by its odometry."""

from array import array
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.io.builder import Skipped
from stillmap.io.ros.messages import frame as frame_name
from stillmap.io.ros.messages import stamp_ns
from stillmap.io.ros.tf import BAD_TRANSFORM, Transforms, is_pose
from stillmap.preprocessing.options import ReadOptions

TAKEN = "the sensor is taken for the robot: nothing says where it sits on one"

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
        self.skipped = Skipped()
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


class Places(NamedTuple):
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


def base_frame(
    transforms: Transforms, sensors: list[str], odometry: list[Odometry], options: ReadOptions
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
    path = transforms.path_up(sensors[0])
    for one in odometry:
        if one.child and one.child in path:
            return one.child, f"{one.topic} names it"
    for name in _NAMES:
        found = [above for above in path[1:] if above.rpartition("/")[2] == name]
        if found:
            return found[0], "by its name"
    for below in path:
        if transforms.changes(below):
            if below == sensors[0]:
                break
            return below, f"it moves in {transforms.parent(below)}"
    if len(path) > 1 and not any(map(transforms.changes, path)):
        return path[-1], "all frames hang on it"
    return sensors[0], TAKEN


def places(
    transforms: Transforms, base: tuple[str, str], sensors: list[tuple[str, NDArray[np.int64]]]
) -> Places:
    """Where sensors sit on the robot, each at its own times (N,)."""
    found, moves = [], []
    for name, at_ns in sensors:
        located = transforms.located(base[0], name, at_ns)
        found.append(None if located is None else located.T)
        moves.append(located is not None and located.moves)
    return Places(*base, found, moves)


def words(placed: Places) -> list[str]:
    """A warning where the robot's frame is a makeshift."""
    if placed.how != TAKEN:
        return []
    return [f"no transform says where {placed.base!r} sits on a robot: took the laser as the base"]


def planar(T: NDArray[np.float64]) -> tuple[NDArray[np.float64], bool, bool]:
    """A level laser seen from above: (N, 3, 3), whether it hangs upside down, whether it tilts."""
    up = T[:, 2, 2]
    theta = np.arctan2(T[:, 1, 0], T[:, 0, 0])
    flat = se2.matrix(T[:, 0, 3], T[:, 1, 3], theta)
    return flat, bool(np.median(up) < 0.0), bool(np.any(np.abs(up) < _TILTED))


def odometry_at(
    transforms: Transforms,
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
    named = _frame_above(transforms, base) if frame is None else frame
    if named in transforms.frames:
        found = transforms.located(named, base, at_ns)
        if found is not None and found.moves:
            gap = _largest_gap(transforms.stamps_between(named, base), at_ns)
            return found.T, *_told(f"TF from {named} to {base}", found.outside, gap)
    for one in sorted(odometry, key=lambda o: -len(o.stamp_ns)):
        if frame in (None, one.frame) and len(one.stamp_ns):
            return _from_topic(one, transforms, base, at_ns)
    return None, {"from": None, "outside": 0}, []


def _from_topic(
    one: Odometry, transforms: Transforms, base: str, at_ns: NDArray[np.int64]
) -> tuple[NDArray[np.float64], dict[str, Any], list[str]]:
    alone = Transforms()
    stamps = list(one.stamp_ns)
    for stamp, values in zip(stamps, np.asarray(one.values).reshape(-1, 7).tolist(), strict=True):
        alone.add_one("odometry", "robot", stamp, tuple(values), static=False)
    found = alone.located("odometry", "robot", at_ns)
    assert found is not None
    T, more = found.T, []
    on_robot = transforms.located(one.child, base, at_ns) if one.child != base else None
    if on_robot is not None:
        T = T @ on_robot.T
    elif one.child not in ("", base):
        more = [f"{one.topic}: taken for {base}, though it speaks of {one.child}"]
    told, warnings = _told(one.topic, found.outside, _largest_gap(np.array(stamps), at_ns))
    return T, told, more + warnings


def _frame_above(transforms: Transforms, base: str) -> str:
    """The frame in which the robot moves first, on the way up."""
    for name in transforms.path_up(base):
        above = transforms.parent(name)
        if above is not None and transforms.changes(name):
            return above
    return ""


def _largest_gap(stamps: NDArray[np.int64], at_ns: NDArray[np.int64]) -> float:
    """s: the longest time without odometry during the scans."""
    stamps = np.sort(stamps)
    if not len(at_ns) or not len(stamps):
        return 0.0
    stamps = stamps[(stamps >= at_ns[0]) & (stamps <= at_ns[-1])]
    return float(np.diff(stamps).max(initial=0)) / 1e9


def _told(origin: str, outside: int, gap: float) -> tuple[dict[str, Any], list[str]]:
    warnings = []
    if outside:
        warnings.append(f"{outside} scans outside the time of the odometry: nearest pose")
    if gap > _GAP:
        warnings.append(f"no odometry for {gap:.1f} s: interpolated over the gap")
    return {"from": origin, "outside": outside}, warnings
