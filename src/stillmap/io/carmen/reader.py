"""Reads CARMEN logs (`.log`, `.clf`, plain or gzip)."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Float
from stillmap.core.errors import InputError, advise
from stillmap.core.source import LaserPose, SensorNotes, Source
from stillmap.io import trajectory
from stillmap.io.builder import ReadContext
from stillmap.io.carmen.log import (
    SCAN_KINDS,
    WITHOUT_ANGLES,
    CarmenLog,
    LaserLog,
    flaser_config,
    read_log,
)
from stillmap.io.text_lines import Line, read_head
from stillmap.prepare.lasers import RawLasers, scan_order, unit_vectors
from stillmap.prepare.options import LaserOptions, ReadOptions
from stillmap.prepare.time_window import TimeWindow

_HEAD = 1 << 18  # bytes with the PARAM lines of a log
_KIND_ORDER = ("ROBOTLASER", "FLASER", "RLASER", "RAWLASER")  # preference for the same laser
# differences between laser and robot pose that agree: old logs round to cm. A corrected pose in
# the laser field differs by metres, and differently in each scan
_SAME_DISTANCE, _SAME_ANGLE = 0.02, 0.01  # m, rad
_MAX_OFFSET = 3.0  # m on a robot
_MIN_OFFSET = 0.002  # m or rad: less is rounding


def read(paths: Sequence[Path], context: ReadContext, others: Sequence[Path] = ()) -> RawLasers:
    """Read the parts of a CARMEN log, in order of time, as one.

    Bad records are counted in `source.skipped` (scans) and `source.skipped_odometry`, with
    line numbers, which count through all parts. PARAM lines are in the first part alone: without
    any, those of one of the `others` count.

    Raises:
        InputError: a file cannot be read, or they hold no usable scan.
    """
    window = TimeWindow(context.options)
    log = read_log(paths, context.progress, window)
    for path in others if not log.params else ():
        for text in read_head(path, _HEAD).splitlines():
            if text.startswith(b"PARAM"):
                log.add(Line(log.n_lines, text))
    scans, duplicates = select_scans(log)
    if not scans:
        raise _no_scan_error(paths[0], log)
    raw = _describe_lasers(scans, log, context.options)
    source = raw.source
    source.path, source.part, source.duplicates = str(paths[0]), window.part, duplicates
    return raw


def _no_scan_error(path: Path, log: CarmenLog) -> InputError:
    skipped = log.skipped.merge(*log.skipped_scans.values())
    what = "holds no laser line" if log.n_lines else "is empty"
    if skipped.total:
        what = f"holds no usable laser scan: {skipped.summary()}"
    kinds = ", ".join(name.decode() for name in SCAN_KINDS)
    return InputError(what, where=str(path), hint=f"a CARMEN log has lines of {kinds}")


def select_scans(log: CarmenLog) -> tuple[list[LaserLog], list[str]]:
    """The usable scans of each laser, and sentences on dropped kinds of lines.

    One kind of line per laser is used: newer logs hold each scan raw and with the robot's pose.
    """
    by_position: dict[str, list[LaserLog]] = {}
    for laser in log.lasers.values():
        by_position.setdefault(_position(laser.kind, log.params), []).append(laser)
    used, notes = [], []
    for same in by_position.values():
        most = max(map(len, same))
        # a kind with only a few of the scans cannot replace the others
        complete = [laser for laser in same if 2 * len(laser) >= most]
        best = min(complete, key=lambda laser: _KIND_ORDER.index(laser.kind.rstrip("1234")))
        used.append(best)
        notes += [
            f"{laser.kind}: {len(laser)} scans not used, {best.kind} shows the same laser"
            for laser in same
            if laser is not best
        ]
    used.sort(key=lambda laser: SCAN_KINDS.index(laser.kind.encode()))
    for laser in used:
        laser.select_usable(log.skipped_scans[laser.kind])
    return used, notes


def _describe_lasers(used: list[LaserLog], log: CarmenLog, options: ReadOptions) -> RawLasers:
    options.check_laser_count(len(used))
    skipped = log.skipped.merge(*(log.skipped_scans[laser.kind] for laser in used))
    warnings = skipped.loss_warnings(sum(len(laser.line) for laser in used))
    lasers, mounts, sensors = [], [], []
    for number, laser in enumerate(used):
        given = options.laser(number)
        pose = find_pose(laser, log.params, warnings).override(given.pose)
        upside_down, upside_down_how = _find_upside_down(laser.kind, log.params, given)
        angles = _find_angles(laser, log.params, given, warnings)
        angles = -angles if upside_down else angles
        counts = [config.n for config in laser.configs]
        configs = zip(angles, counts, strict=True)
        directions = [unit_vectors(first + step * np.arange(n)) for (first, step), n in configs]
        raw = laser.raw(directions, _find_max_range(laser, log.params))
        first, step = angles[raw.typical_shape].tolist()
        lasers.append(raw)
        mounts.append(pose.matrix()[None])
        sensors.append(
            SensorNotes(
                laser.kind,
                scans=len(laser.line),
                beams_per_scan=counts[raw.typical_shape],
                start_angle=first,
                angle_step=step,
                upside_down=upside_down,
                upside_down_how=upside_down_how,
                extrinsics=pose,
            )
        )
    odometry, odometry_notes = _find_odometry(used, log, warnings)
    T_odom_base = None if odometry is None else se2.matrix(*odometry[scan_order(lasers)].T)
    params = {k: v for k, v in log.params.items() if k.startswith("robot_") and "laser" in k}
    source = Source(
        format="carmen",
        details={"lines": log.n_lines},
        records=dict(log.records),
        ignored=dict(log.ignored),
        sensors=sensors,
        odometry=odometry_notes,
        params=params,
        skipped_odometry=log.skipped_odometry.by_reason(),
        skipped=skipped.by_reason(),
        warnings=warnings,
    )
    return RawLasers(lasers, mounts, T_odom_base, source)


def _param(params: dict[str, str], name: str) -> float | None:
    """The PARAM of this name as a finite number; None if there is none."""
    try:
        value = float(params[name])
    except (KeyError, ValueError):
        return None
    return value if abs(value) < 1e6 else None


def _position(kind: str, params: dict[str, str]) -> str:
    """`front`, `rear` or the kind itself: kinds of the same position show the same laser."""
    if kind in ("FLASER", "ROBOTLASER1"):
        return "front"
    if kind in ("RLASER", "ROBOTLASER2"):
        return "rear"
    for position, default in (("front", 1.0), ("rear", 2.0)):
        stated = _param(params, f"robot_{position}laser_id")
        if float(kind[-1]) == (default if stated is None else stated):
            return position
    return kind


def find_pose(laser: LaserLog, params: dict[str, str], warnings: list[str]) -> LaserPose:
    """The pose of a laser on the robot; adds warnings.

    In this order: the median pose of the laser relative to the robot on the scan lines, if scans
    agree on it; PARAMs; facing backwards for RLASER; the robot's center.
    """
    kind = laser.kind
    if laser.laser_poses is not None and laser.robot_poses is not None:
        offset, alike = _median_offset(laser.laser_poses, laser.robot_poses)
        x, y, theta = (round(float(value), 6) for value in offset)
        if alike and is_stated_by_lines(x, y, theta):
            return LaserPose(x, y, theta, "scan lines")
        if not alike:
            warnings.append(
                f"{kind}: the laser poses on the scan lines do not keep to one place on the "
                "robot (a corrected log?): not used"
            )
    position = _position(kind, params)
    names = ("offset", "side_offset", "angular_offset")
    stated = [_param(params, f"robot_{position}laser_{name}") for name in names]
    if any(value is not None for value in stated):
        turn = math.pi if position == "rear" else 0.0
        if stated[2] is not None:  # some logs write degrees
            degrees = abs(stated[2]) > 2.0 * math.pi
            turn = math.radians(stated[2]) if degrees else stated[2]
        return LaserPose(stated[0] or 0.0, stated[1] or 0.0, turn, "PARAM")
    if kind == "RLASER":
        return LaserPose(0.0, 0.0, math.pi, "a rear laser faces backwards")
    if kind in ("RAWLASER2", "RAWLASER3", "RAWLASER4"):
        warnings.append(f"{kind}: the log does not state its pose: robot center assumed")
    return LaserPose(0.0, 0.0, 0.0, "robot center assumed")


def is_stated_by_lines(x: float, y: float, theta: float) -> bool:
    """True if a pose from scan lines is plausible: on the robot, and not at its center."""
    distance = math.hypot(x, y)
    return distance < _MAX_OFFSET and max(distance, abs(theta)) > _MIN_OFFSET


def _median_offset(laser: Float, robot: Float) -> tuple[Float, bool]:
    """Median (x, y, theta) of the laser in the robot's frame, and whether scans agree on it."""
    T_odom_sensor, T_odom_base = se2.matrix(*laser.T), se2.matrix(*robot.T)
    offsets = se2.parameters(se2.inverse(T_odom_base) @ T_odom_sensor)
    # unwrap about the first: angles near pi lie on both sides of the cut
    offsets[:, 2] = offsets[0, 2] + se2.wrap(offsets[:, 2] - offsets[0, 2])
    middle = np.median(offsets, axis=0)
    off = np.abs(offsets - middle)
    alike = np.mean((off[:, :2].max(axis=1) < _SAME_DISTANCE) & (off[:, 2] < _SAME_ANGLE)) > 0.9
    return middle, bool(alike) and bool(np.hypot(*middle[:2]) < _MAX_OFFSET)


def _find_upside_down(kind: str, params: dict[str, str], given: LaserOptions) -> tuple[bool, str]:
    """True if a laser is mounted upside down, its beams turning clockwise, and the source.

    CARMEN's own laser_..._flipped does not tell: its laser server reverses such readings before
    they are logged.
    """
    if given.upside_down is not None:
        return given.upside_down, "given"
    stated = _param(params, f"robot_{_position(kind, params)}laser_flipped")
    return (False, "assumed") if stated is None else (stated != 0.0, "PARAM")


def _find_angles(
    laser: LaserLog, params: dict[str, str], given: LaserOptions, warnings: list[str]
) -> Float:
    """(C, 2) first angle and step in radians of each of the laser's configs, as declared."""
    kind, configs = laser.kind, list(laser.configs)
    if kind in WITHOUT_ANGLES:
        fov = given.fov
        degrees = _param(params, f"laser_{_position(kind, params)}_laser_fov")
        if fov is None and degrees is not None and 0.0 < degrees <= 360.0:
            fov = math.radians(degrees)
        if fov is not None:
            configs = [flaser_config(config.n, fov) for config in configs]
    elif given.fov is not None:
        text = "its lines declare their angles: the given field of view is not used"
        warnings.append(f"{kind}: {text}")
    return np.array([config[:2] for config in configs])


def _find_max_range(laser: LaserLog, params: dict[str, str]) -> float | None:
    """The declared maximum range in metres, the smaller of PARAM and headers; None: not stated."""
    in_headers = [config.max_range for config in laser.configs if config.max_range is not None]
    in_params = _param(params, f"robot_{_position(laser.kind, params)}_laser_max")
    # single headers may be damaged: the largest is the most cautious
    stated = [max(in_headers)] if in_headers else []
    if in_params is not None and in_params > 0.0:
        stated.append(in_params)
    return min(stated) if stated else None


def _find_odometry(
    lasers: list[LaserLog], log: CarmenLog, warnings: list[str]
) -> tuple[Float | None, dict[str, Any]]:
    """Robot poses (T, 3) at the scans of all lasers, one laser after the other.

    The pose on the scan line comes first, else ODOM lines, else poses on other lasers' lines are
    interpolated. Poses on scan lines that never change while ODOM lines do are ignored.
    """
    line, odom_ns = np.asarray(log.odom_rows).reshape(-1, 2).T
    order = log.skipped_odometry.order_in_time(odom_ns, line)
    odom_ns, odom = odom_ns[order], np.asarray(log.odom_poses).reshape(-1, 3)[order]
    own = {laser.kind: laser.robot_poses for laser in lasers if laser.robot_poses is not None}
    if len(odom) and own and not any(map(_moves, own.values())) and _moves(odom):
        own = {}
    if not len(odom) and own:
        odom_ns = np.concatenate([laser.stamp_ns for laser in lasers if laser.kind in own])
        odom = np.concatenate(list(own.values()))
    if not len(odom):
        return None, trajectory.describe_odometry(None, 0, warnings)
    poses, outside = [], 0
    for laser in lasers:
        at_scans, n_outside = own.get(laser.kind), 0
        if at_scans is None:
            at_scans, n_outside = trajectory.interpolate(odom_ns, odom, laser.stamp_ns)
        poses.append(at_scans)
        outside += n_outside
    out = np.concatenate(poses)
    interpolated = "ODOM lines" if len(log.odom_rows) else "other lasers' scan lines"
    kinds = (["scan lines"] if own else []) + ([interpolated] if len(own) < len(lasers) else [])
    notes = trajectory.describe_odometry(" and ".join(kinds), outside, warnings)
    if len(out) > 1 and not _moves(out):
        todo = "if the robot did, map without odometry"
        warnings.append(advise("the odometry never moves", todo))
    return out, notes


def _moves(poses: Float) -> bool:
    return bool(np.any(poses != poses[0]))
