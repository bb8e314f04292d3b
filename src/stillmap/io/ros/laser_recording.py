"""Builds recordings from the laser scans of a bag: in 2D, or in 3D where the laser tilts."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays, se2
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.io.builder import ReadContext, SkippedRecords
from stillmap.io.ros import base_frame, scan_beams
from stillmap.io.ros.base_frame import LaserSelection
from stillmap.io.ros.collect import BagContent
from stillmap.io.ros.laser_scan import LaserScans
from stillmap.prepare.lasers import LaserPose
from stillmap.prepare.options import ReadOptions

Float = NDArray[np.float64]

_STILL_DISTANCE, _STILL_ANGLE = 1e-3, 1e-3  # m, rad: a sensor that moves less is fixed
_MIN_TILT = 0.02  # rad: a laser that turns by less does not tilt
_MAX_PAUSE = 500_000_000  # ns between transforms over which the joint's angle is interpolated
_BLOCK = 1 << 14  # beams at a time


def build_laser_recording(content: BagContent, context: ReadContext) -> Recording:
    """Build the 2D recording of all lasers.

    Raises:
        InputError: no scan can be used, or options do not fit the lasers.
    """
    options = context.options
    lasers = base_frame.select_lasers(content, options)
    used, poses = lasers.scans, lasers.poses
    options.check_laser_count(len(used))
    warnings = [w for s in used for w in s.warnings] + poses.warnings
    mountings = _find_mountings(lasers, options, warnings)
    rules = []
    for scans, mounting in zip(used, mountings, strict=True):
        rule, more = scan_beams.find_range_rule(scans, options)
        mounting.notes["ranges"] = rule.to_dict()
        rules.append(rule)
        warnings += [f"{scans.topic}: {text}" for text in more]
    mirrored = [mounting.upside_down for mounting in mountings]
    beams = scan_beams.convert_to_beams(used, rules, mirrored, context.scratch)
    stamp_ns = np.concatenate([s.stamp_ns for s in used])[beams.scan]
    odom, origin = base_frame.find_odometry(content, poses.base, stamp_ns, options, warnings)
    skipped = SkippedRecords().merge(*(lasers.skipped[topic] for topic in {s.topic for s in used}))
    warnings += skipped.loss_warnings(sum(s.n_scans for s in used), "message")
    return Recording(
        stamp_ns=stamp_ns,
        offset=beams.offset,
        points=beams.points,
        hit=beams.hit,
        T_base_sensor=np.concatenate([mounting.T_base_sensor for mounting in mountings]),
        sensor=_number_sensors(used, mountings)[beams.scan],
        T_odom_base=None if odom is None else base_frame.project_to_plane(odom)[0],
        beam_time=beams.beam_time,
        record=np.concatenate([s.number for s in used])[beams.scan],
        source={
            "sensors": [mounting.notes for mounting in mountings],
            "base_frame": poses.base,
            "base_frame_how": poses.how,
            "odometry": origin,
            "skipped": skipped.to_dict(),
            "duplicates": lasers.omitted,
            "warnings": warnings,
        },
    )


class _Mounting(NamedTuple):
    """A laser on the robot.

    Attributes:
        T_base_sensor: (1, 3, 3), or (T, 3, 3) where it moves on the robot.
        upside_down: its angles change their sign.
        notes: for `source`.
    """

    T_base_sensor: Float
    upside_down: bool
    notes: dict[str, Any]


def _find_mountings(
    lasers: LaserSelection, options: ReadOptions, warnings: list[str]
) -> list[_Mounting]:
    base = lasers.poses.base
    out = []
    for number, (scans, T) in enumerate(zip(lasers.scans, lasers.T_base_sensor, strict=True)):
        flat, upside_down, tilts = base_frame.project_to_plane(T)
        given = options.laser(number)
        if tilts:
            warnings.append(f"{scans.topic}: the laser is tilted; its scans are treated as level")
        x, y, theta = se2.parameters(flat)[0].tolist()
        if not _moves(flat) or given.pose != (None, None, None):
            same = scans.frame == base
            how = "the laser is the robot's frame" if same else f"TF from {base} to {scans.frame}"
            pose = LaserPose(x, y, theta, how).override(given)
            flat = pose.matrix()[None]
        else:
            pose = LaserPose(x, y, theta, "TF, it moves: at its first scan")
        upside_down_how = "TF"
        if given.upside_down is not None:
            upside_down, upside_down_how = given.upside_down, "given"
        shape, sign = scans.typical_shape, -1.0 if upside_down else 1.0
        notes = {
            "name": scans.topic,
            "frame": scans.frame,
            "scans": scans.n_scans,
            "beams_per_scan": shape.n,
            "start_angle": sign * shape.angle_min,
            "angle_step": sign * shape.angle_increment,
            "upside_down": upside_down,
            "upside_down_how": upside_down_how,
            "extrinsics": pose._asdict(),
            "places": len(flat),
        }
        out.append(_Mounting(flat, upside_down, notes))
    return out


def _moves(flat: Float) -> bool:
    offset = np.abs(se2.parameters(se2.inverse(flat[:1]) @ flat))
    return bool(offset[:, :2].max() > _STILL_DISTANCE or offset[:, 2].max() > _STILL_ANGLE)


def _number_sensors(lasers: list[LaserScans], mountings: list[_Mounting]) -> NDArray[np.int32]:
    """(T,) the sensor of each scan of all lasers; one that moves has a sensor per scan."""
    numbers, count = [], 0
    for scans, mounting in zip(lasers, mountings, strict=True):
        n = len(mounting.T_base_sensor)
        of_laser = np.arange(scans.n_scans) if n > 1 else np.zeros(scans.n_scans)
        numbers.append((of_laser + count).astype(np.int32))
        count += n
    return np.concatenate(numbers)


def build_tilting_recording(content: BagContent, context: ReadContext) -> Recording:
    """Build the 3D recording of a laser that tilts or pans.

    Every scan has a sensor of its own at the laser's pose at the scan's stamp; beams are placed by
    the laser's pose at their own times. Where transforms are missing, beams are unusable.

    Raises:
        InputError: there are several lasers, or this one does not move on the robot.
    """
    scratch = context.scratch
    lasers = base_frame.select_lasers(content, context.options)
    scans, T_base_sensor, poses = lasers.scans[0], lasers.T_base_sensor[0], lasers.poses
    if len(lasers.scans) > 1:
        raise InputError(f"{scans.topic}: scans of several lasers: only one can tilt")
    if _largest_rotation(T_base_sensor) < _MIN_TILT:
        hint = "transforms must say how the joint moves, as robot_state_publisher does"
        what = f"{scans.topic}: {scans.frame!r} does not tilt in {poses.base!r}"
        raise InputError(what, hint=hint)
    rule, more = scan_beams.find_range_rule(scans, context.options)
    beams = scan_beams.convert_to_beams([scans], [rule], [False], scratch)
    points, n_lost = _convert_to_3d(content, poses.base, scans, beams, T_base_sensor, scratch)
    hit = arrays.copy(beams.hit, scratch)
    for block in arrays.iter_blocks(hit, points):
        hit[block] &= ~np.isnan(points[block, 0])
    warnings = [*scans.warnings, *(f"{scans.topic}: {text}" for text in more)]
    if n_lost:
        warnings.append(f"{n_lost} beams where transforms do not say how the laser is tilted")
    skipped = lasers.skipped[scans.topic]
    notes = {
        "name": scans.topic,
        "frame": scans.frame,
        "scans": scans.n_scans,
        "places": scans.n_scans,
        "ranges": rule.to_dict(),
    }
    return Recording(
        stamp_ns=scans.stamp_ns[beams.scan],
        offset=beams.offset,
        points=points,
        hit=hit,
        T_base_sensor=T_base_sensor[beams.scan],
        sensor=np.arange(scans.n_scans, dtype=np.int32),
        T_odom_base=None,
        beam_time=beams.beam_time,
        source={
            "sensors": [notes],
            "base_frame": poses.base,
            "base_frame_how": poses.how,
            "skipped": skipped.to_dict(),
            "warnings": warnings + skipped.loss_warnings(scans.n_scans, "message"),
        },
    )


def _largest_rotation(T: Float) -> float:
    """The largest angle between the first of poses (N, 4, 4) and another, in radians."""
    trace = np.einsum("ij,nij->n", T[0, :3, :3], T[:, :3, :3])
    return float(np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0)).max())


def _convert_to_3d(
    content: BagContent,
    base: str,
    scans: LaserScans,
    beams: scan_beams.Beams,
    T_base_sensor: Float,
    scratch: Path | None,
) -> tuple[NDArray[np.float32], int]:
    """Points (M, 3) in the laser's frame at its scan's stamp, and the number of lost beams."""
    stamps = np.sort(content.transforms.stamps_between(base, scans.frame))
    M = len(beams.points)
    points = arrays.empty((M, 3), np.float32, scratch)
    n_lost = 0
    for first in range(0, M, _BLOCK):
        block = slice(first, min(first + _BLOCK, M))
        scan = np.searchsorted(beams.offset, np.arange(block.start, block.stop), side="right") - 1
        at_ns = scans.stamp_ns[beams.scan[scan]]
        if beams.beam_time is not None:
            after_ns = np.round(1e9 * beams.beam_time[block].astype(np.float64))
            at_ns = at_ns + after_ns.astype(np.int64)
        found = content.transforms.lookup(base, scans.frame, at_ns)
        assert found is not None  # connected at the stamps, so connected
        T = se2.inverse(T_base_sensor[beams.scan[scan]]) @ found.T
        ends = np.einsum("nij,nj->ni", T[:, :3, :2], beams.points[block].astype(np.float64))
        is_lost = ~_is_covered(stamps, at_ns)
        n_lost += int(np.count_nonzero(is_lost & np.isfinite(ends[:, 0])))
        points[block] = np.where(is_lost[:, None], np.nan, ends + T[:, :3, 3])
        arrays.release_pages(points)
    return points, n_lost


def _is_covered(stamps: NDArray[np.int64], at_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(n,) whether times lie on, or between close, sorted stamps."""
    after = np.searchsorted(stamps, at_ns)
    inside = (after > 0) & (after < len(stamps))
    k = np.clip(after, 1, len(stamps) - 1)
    exact = stamps[np.minimum(after, len(stamps) - 1)] == at_ns
    return np.asarray(exact | (inside & (stamps[k] - stamps[k - 1] <= _MAX_PAUSE)))
