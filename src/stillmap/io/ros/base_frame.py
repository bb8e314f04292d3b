"""Finds the base frame of a robot, its sensors' poses, and its odometry in the transform tree."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.io.builder import SkippedRecords
from stillmap.io.ros.collect import BagContent
from stillmap.io.ros.laser_scan import LaserScans
from stillmap.io.ros.tf import Lookup, Odometry, TransformTree
from stillmap.prepare.options import ReadOptions

Float = NDArray[np.float64]

SENSOR_IS_BASE = "the sensor's frame: no transform gives its pose on a robot"

_BASE_NAMES = ("base_link", "base_footprint", "base")
_MAX_GAP = 1.0  # s without odometry before a warning
_MIN_UPRIGHT = 0.9  # cosine of the largest tilt of a laser that counts as level
_MIN_SHARE = 0.25  # of the most frequent laser's scans: rarer topics are no sensors of their own


class SensorPoses(NamedTuple):
    """Poses of sensors on the robot.

    Attributes:
        base: base frame.
        how: how it was found.
        T_base_sensor: for each sensor (N, 4, 4) at its scans; None where its frame is not
            connected with the base.
        warnings: sentences.
    """

    base: str
    how: str
    T_base_sensor: list[Float | None]
    warnings: list[str]


def find_sensor_poses(
    content: BagContent, sensors: list[tuple[str, NDArray[np.int64]]], options: ReadOptions
) -> SensorPoses:
    """Find the base frame, and the poses of sensors (frame, stamps (N,)) in it.

    Raises:
        InputError: the options name a frame that is not there.
    """
    tree = content.transforms
    base, how = _find_base_frame(tree, [frame for frame, _ in sensors], content.odometry, options)
    found = [tree.lookup(base, frame, at_ns) for frame, at_ns in sensors]
    warning = f"no transform gives the pose of {base!r} on a robot: it is used as the base frame"
    warnings = [warning] if how == SENSOR_IS_BASE else []
    return SensorPoses(base, how, [None if f is None else f.T for f in found], warnings)


def _find_base_frame(
    tree: TransformTree, sensors: list[str], odometry: list[Odometry], options: ReadOptions
) -> tuple[str, str]:
    """The base frame, and how it was found."""
    given = options.base_frame
    if given is not None:
        if given not in tree.frames and given not in sensors:
            known = ", ".join(sorted(tree.frames | set(sensors))[:20])
            raise InputError(f"base frame {given!r} is not in the recording", hint=f"has: {known}")
        return given, "given"
    path = tree.path_to_root(sensors[0])
    for one in odometry:
        if one.child and one.child in path:
            return one.child, f"{one.topic} names it"
    for name in _BASE_NAMES:
        found = [above for above in path[1:] if above.rpartition("/")[2] == name]
        if found:
            return found[0], "by its name"
    lowest = next((frame for frame in path if tree.is_moving(frame)), None)
    if lowest is not None and lowest != sensors[0]:
        return lowest, f"it moves in {tree.parent(lowest)}"
    if lowest is None and len(path) > 1:
        return path[-1], "all frames hang on it"
    return sensors[0], SENSOR_IS_BASE


class LaserSelection(NamedTuple):
    """The lasers to use.

    Attributes:
        scans: of each laser.
        T_base_sensor: (T, 4, 4) of each laser at its scans.
        poses: base frame and warnings.
        skipped: messages that were skipped, by topic.
        omitted: sentences on lasers that are not used.
    """

    scans: list[LaserScans]
    T_base_sensor: list[Float]
    poses: SensorPoses
    skipped: dict[str, SkippedRecords]
    omitted: list[str]


def select_lasers(content: BagContent, options: ReadOptions) -> LaserSelection:
    """Select the lasers whose pose on the robot is known.

    Raises:
        InputError: there is none.
    """
    lasers, skipped = content.lasers.finish()
    if not lasers:
        total = SkippedRecords().merge(*skipped.values())
        raise InputError(f"holds no usable laser scan: {total.summary('message')}")
    # most scans first, of equal ones most beams, then by name
    lasers.sort(key=lambda s: (-s.n_scans, -int(s.lengths[0]), s.topic))
    sensors = [(s.topic, s.frame, s.n_scans) for s in lasers]
    order, omitted = drop_duplicates(sensors, "scans", named=options.topic is not None)
    lasers = [lasers[k] for k in order]
    poses = find_sensor_poses(content, [(s.frame, s.stamp_ns) for s in lasers], options)
    used: list[LaserScans] = []
    T: list[Float] = []
    for scans, found in zip(lasers, poses.T_base_sensor, strict=True):
        if found is None and options.base_frame is not None and not used:
            raise InputError(f"no transform connects {scans.frame!r} with {poses.base!r}")
        if found is None and used:
            omitted.append(
                f"{scans.topic}: {scans.n_scans} scans, no transform connects {scans.frame!r} with "
                f"{used[0].frame!r} (read.topic = {scans.topic!r} takes it instead)"
            )
            continue
        used.append(scans)
        T.append(np.tile(np.eye(4), (scans.n_scans, 1, 1)) if found is None else found)
    require_named_topics([s.topic for s in used], omitted, options)
    return LaserSelection(used, T, poses, skipped, omitted)


def require_named_topics(used: list[str], omitted: list[str], options: ReadOptions) -> None:
    """Refuse to leave out a topic that the user named.

    Args:
        used: topics of the sensors that are used.
        omitted: sentences on the others, which begin with the topic.
        options: names the topics.

    Raises:
        InputError: one of them is not used.
    """
    named = {name.strip().removeprefix("/") for name in (options.topic or "").split(",")}
    for name in sorted(named - {topic.removeprefix("/") for topic in used}):
        for text in omitted:
            topic, _, why = text.partition(": ")
            if topic.removeprefix("/") == name:
                others = " and ".join(used)
                raise InputError(f"topic {topic!r} cannot be used with {others}: {why}")


def drop_duplicates(
    sensors: list[tuple[str, str, int]], unit: str, *, named: bool
) -> tuple[list[int], list[str]]:
    """Keep one topic per sensor: of topics in the same frame the first.

    Args:
        sensors: topic, frame and number of scans, in order of preference.
        unit: of the scans.
        named: the user named the topics; otherwise topics with few scans are dropped too.

    Returns:
        Indices of those to use, and sentences on the others.
    """
    most = max(n for _, _, n in sensors)
    used: list[int] = []
    dropped = []
    for k, (topic, frame, n) in enumerate(sensors):
        same = next((sensors[u][0] for u in used if sensors[u][1] == frame), None)
        if same is not None:
            dropped.append(f"{topic}: {n} {unit}, {same} shows the same sensor")
        elif not named and n < _MIN_SHARE * most:
            dropped.append(f"{topic}: {n} {unit} are too few")
        else:
            used.append(k)
    return used, dropped


def project_to_plane(T: Float) -> tuple[Float, bool, bool]:
    """2D poses (N, 3, 3) of a laser, whether it is mounted upside down, whether it is tilted."""
    up = T[:, 2, 2]
    theta = np.arctan2(T[:, 1, 0], T[:, 0, 0])
    flat = se2.matrix(T[:, 0, 3], T[:, 1, 3], theta)
    return flat, bool(np.median(up) < 0.0), bool(np.any(np.abs(up) < _MIN_UPRIGHT))


def find_odometry(
    content: BagContent,
    base: str,
    at_ns: NDArray[np.int64],
    options: ReadOptions,
    warnings: list[str],
) -> tuple[Float | None, dict[str, Any]]:
    """Odometry (T, 4, 4) at the scans, and its origin (for `source`); adds warnings.

    Transforms to a frame in which the base moves come first, then Odometry topics.

    Raises:
        InputError: the options name a frame that is not there.
    """
    tree, odometry, frame = content.transforms, content.odometry, options.odom_frame
    if frame is not None and frame not in tree.frames | {o.frame for o in odometry}:
        raise InputError(f"odometry frame {frame!r} is not in the recording")
    odom = _find_odom_frame(tree, base) if frame is None else frame
    if odom in tree.frames:
        found = tree.lookup(odom, base, at_ns)
        if found is not None and found.moves:
            warnings += _coverage_warnings(found, tree.stamps_between(odom, base), at_ns)
            return found.T, {"from": f"TF from {odom} to {base}", "outside": found.outside}
    for one in sorted(odometry, key=lambda o: -len(o.stamp_ns)):
        if frame in (None, one.frame):
            found, T_child_base = one.poses_at(at_ns), None
            if one.child != base:
                T_child_base = tree.lookup(one.child, base, at_ns)
            if T_child_base is None and one.child not in ("", base):
                text = f"used as the pose of {base}, although it is of {one.child}"
                warnings.append(f"{one.topic}: {text}")
            warnings += _coverage_warnings(found, np.asarray(one.stamp_ns), at_ns)
            T = found.T if T_child_base is None else found.T @ T_child_base.T
            return T, {"from": one.topic, "outside": found.outside}
    return None, {"from": None, "outside": 0}


def _find_odom_frame(tree: TransformTree, base: str) -> str:
    """The nearest frame above the base in which it moves, "" if there is none."""
    for name in tree.path_to_root(base):
        parent = tree.parent(name)
        if parent is not None and tree.is_moving(name):
            return parent
    return ""


def _largest_gap(stamps: NDArray[np.int64], at_ns: NDArray[np.int64]) -> float:
    """The longest time without odometry during the scans, in seconds."""
    stamps = np.sort(stamps)
    if not len(at_ns) or not len(stamps):
        return 0.0
    stamps = stamps[(stamps >= at_ns[0]) & (stamps <= at_ns[-1])]
    return float(np.diff(stamps).max(initial=0)) / 1e9


def _coverage_warnings(
    found: Lookup, stamps: NDArray[np.int64], at_ns: NDArray[np.int64]
) -> list[str]:
    """Warnings on scans at times (T,) outside odometry of these stamps, or in a gap of it."""
    warnings = []
    if found.outside:
        warnings.append(f"{found.outside} scans outside the time of the odometry: nearest pose")
    gap = _largest_gap(stamps, at_ns)
    if gap > _MAX_GAP:
        warnings.append(f"no odometry for {gap:.1f} s: interpolated over the gap")
    return warnings
