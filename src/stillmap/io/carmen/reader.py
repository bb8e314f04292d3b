"""Reads CARMEN logs (`.log`, `.clf`, plain or gzip) as recordings."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.advice import advise
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.io import trajectory
from stillmap.io.builder import ReadContext
from stillmap.io.carmen import extrinsics
from stillmap.io.carmen.extrinsics import Extrinsics
from stillmap.io.carmen.log import CarmenLog, read_logs
from stillmap.io.carmen.messages import SCAN_PARSERS, flaser_config
from stillmap.io.carmen.scan_selection import Sensor, scan_order, select_scans
from stillmap.io.text_lines import Line, is_gzip, read_head
from stillmap.prepare import max_range
from stillmap.prepare.options import LaserOptions, ReadOptions
from stillmap.prepare.time_window import TimeWindow

_HEAD = 1 << 18  # bytes with the PARAM lines of a log

_Beams = tuple[NDArray[np.float32], NDArray[np.bool_]]  # points (..., 2) in the sensor frame, hits


def read(path: Path, context: ReadContext) -> Recording:
    """Read a CARMEN log; see `read_parts`."""
    return read_parts([path], context)


def read_parts(
    paths: Sequence[Path], context: ReadContext, others: Sequence[Path] = ()
) -> Recording:
    """Read the parts of a CARMEN log as one.

    Bad records are counted in `source["skipped"]` (scans) and `source["skipped_odometry"]`, by
    reason and with line numbers, which count through all parts.

    Args:
        paths: the files, in order of time.
        context: see ReadContext.
        others: files that may be further parts: PARAM lines are in the first part alone, so that
            one without any takes those of another.

    Raises:
        InputError: a file cannot be read, or they hold no usable scan.
    """
    path = paths[0]
    window = TimeWindow(context.options)
    log = read_logs(paths, context.progress, window)
    if others and not log.params:
        log.params = _find_params(others)
    sensors, notes = select_scans(log)
    if not sensors:
        raise _no_scan_error(path, log)
    recording = _build_recording(sensors, log, context.options)
    recording.source.update(path=str(path), format="carmen", gzip=is_gzip(path))
    if log.n_repeated:
        notes.append(f"{log.n_repeated} lines that earlier parts hold already")
    recording.source.update(duplicates=notes, **window.notes())
    return recording


def _find_params(paths: Sequence[Path]) -> dict[str, str]:
    """The PARAMs at the beginning of the first file that has any."""
    for path in paths:
        log = CarmenLog(TimeWindow(ReadOptions()))
        for text in read_head(path, _HEAD).splitlines():
            if text.startswith(b"PARAM"):
                log.add(Line(1, text))
        if log.params:
            return log.params
    return {}


def _no_scan_error(path: Path, log: CarmenLog) -> InputError:
    kinds = ", ".join(name.decode() for name in SCAN_PARSERS)
    skipped = log.skipped.merge(*log.skipped_scans.values())
    if skipped.total:
        what = f"holds no usable laser scan: {skipped.summary()}"
    else:
        what = "holds no laser line" if log.n_lines else "is empty"
    return InputError(what, where=str(path), hint=f"a CARMEN log has lines of {kinds}")


def _build_recording(sensors: list[Sensor], log: CarmenLog, options: ReadOptions) -> Recording:
    """The recording of all lasers' scans, ordered by stamp."""
    options.check_laser_count(len(sensors))
    skipped = log.skipped.merge(*(log.skipped_scans[s.laser.kind] for s in sensors))
    warnings = skipped.loss_warnings(sum(len(s.stamp_ns) for s in sensors))
    parts, poses, infos = [], [], []
    for number, sensor in enumerate(sensors):
        part, pose, info = _convert_sensor(sensor, log, options, options.laser(number), warnings)
        parts.append(part)
        poses.append(pose.matrix())
        infos.append(info)
    odometry, odometry_info = _find_odometry(sensors, log, warnings)
    sensor_of = np.repeat(np.arange(len(sensors)), [len(s.stamp_ns) for s in sensors])
    stamp_ns = np.concatenate([s.stamp_ns for s in sensors])
    order = scan_order(sensors)
    beams = np.array([s.ranges.shape[1] for s in sensors], np.int64)[sensor_of[order]]
    offset = np.concatenate([[0], np.cumsum(beams)]).astype(np.int64)
    points, hit = _interleave(parts, sensor_of[order], offset)
    params = {k: v for k, v in log.params.items() if k.startswith("robot_") and "laser" in k}
    return Recording(
        stamp_ns=stamp_ns[order],
        offset=offset,
        points=points,
        hit=hit,
        T_base_sensor=np.stack(poses),
        sensor=sensor_of[order].astype(np.int32),
        T_odom_base=None if odometry is None else se2.matrix(*odometry[order].T),
        source={
            "lines": log.n_lines,
            "records": dict(log.records),
            "ignored": dict(log.ignored),
            "sensors": infos,
            "odometry": odometry_info,
            "params": params,
            "skipped_odometry": log.skipped_odometry.to_dict(),
            "skipped": skipped.to_dict(),
            "warnings": warnings,
        },
    )


def _convert_sensor(
    sensor: Sensor, log: CarmenLog, options: ReadOptions, given: LaserOptions, warnings: list[str]
) -> tuple[_Beams, Extrinsics, dict[str, Any]]:
    """End points and hits of a laser, its pose on the robot, and notes for `source`."""
    kind = sensor.laser.kind
    pose, more = extrinsics.find_extrinsics(sensor.laser, sensor.poses, log.params)
    pose = extrinsics.override(pose, given)
    warnings += more
    upside_down, upside_down_how = extrinsics.find_upside_down(kind, log.params, given)
    angles = _find_angles(sensor, log, given, warnings)
    if upside_down:
        angles = -angles
    declared = extrinsics.find_max_range(sensor.laser, log.params)
    rule, more = max_range.infer_range_rule(sensor.ranges, declared, options)
    warnings += [f"{kind}: {text}" for text in more + _angle_warning(sensor)]
    length, hit = max_range.apply_range_rule(sensor.ranges, rule)
    angle = angles[:, :1] + angles[:, 1:] * np.arange(length.shape[1])
    points = np.empty((*length.shape, 2), np.float32)
    points[..., 0] = length * np.cos(angle)[sensor.config]
    points[..., 1] = length * np.sin(angle)[sensor.config]
    first, step = angles[int(np.bincount(sensor.config).argmax())]
    info = {
        "name": kind,
        "scans": len(sensor.stamp_ns),
        "beams_per_scan": sensor.ranges.shape[1],
        "start_angle": float(first),
        "angle_step": float(step),
        "upside_down": upside_down,
        "upside_down_how": upside_down_how,
        "extrinsics": pose._asdict(),
        "ranges": rule.to_dict(),
    }
    return (points, hit), pose, info


def _find_angles(
    sensor: Sensor, log: CarmenLog, given: LaserOptions, warnings: list[str]
) -> NDArray[np.float64]:
    """(C, 2) first angle and step in radians of each of the laser's configs, as declared."""
    angles = np.array([config[:2] for config in sensor.laser.configs])
    fov = extrinsics.find_field_of_view(sensor.laser.kind, log.params, given)
    if sensor.laser.kind in ("FLASER", "RLASER"):
        if fov is not None:
            angles[:] = flaser_config(sensor.ranges.shape[1], fov)[:2]
    elif given.fov is not None:
        text = "its lines declare their angles: the given field of view is not used"
        warnings.append(f"{sensor.laser.kind}: {text}")
    return angles


def _angle_warning(sensor: Sensor) -> list[str]:
    n = sensor.ranges.shape[1]
    for config in sensor.laser.configs:
        fov = n * config.angle_step  # or one step less: both are in use
        if config.field_of_view and abs(fov - config.field_of_view) > 3.0 * config.angle_step:
            return [
                f"{n} readings {np.degrees(config.angle_step):.3g} deg apart are not the declared "
                f"field of view of {np.degrees(config.field_of_view):.4g} deg"
            ]
    return []


def _interleave(
    parts: list[_Beams], sensor_of: NDArray[np.intp], offset: NDArray[np.int64]
) -> _Beams:
    """Points (M, 2) and hits (M,) of all sensors, in the order of the scans."""
    if len(parts) == 1:
        return parts[0][0].reshape(-1, 2), parts[0][1].reshape(-1)
    points = np.empty((offset[-1], 2), np.float32)
    hit = np.empty(offset[-1], np.bool_)
    for number, (part_points, part_hit) in enumerate(parts):
        rows = offset[:-1][sensor_of == number][:, None] + np.arange(part_hit.shape[1])
        points[rows], hit[rows] = part_points, part_hit
    return points, hit


def _find_odometry(
    sensors: list[Sensor], log: CarmenLog, warnings: list[str]
) -> tuple[NDArray[np.float64] | None, dict[str, Any]]:
    """Robot poses (T, 3) at the scans of all sensors, one sensor after the other.

    The pose on the scan line comes first, else ODOM lines, else poses on other lasers' lines are
    interpolated. Poses on scan lines that never change while ODOM lines do are ignored.
    """
    odom_ns = np.asarray(log.odom_stamp_ns, np.int64)
    odom = np.asarray(log.odom_poses).reshape(-1, 3)
    own = {i: s.poses[:, 3:] for i, s in enumerate(sensors) if s.poses is not None}
    if len(odom) and own and not any(_moves(p) for p in own.values()) and _moves(odom):
        own = {}
    if not len(odom) and own:
        odom_ns = np.concatenate([sensors[i].stamp_ns for i in own])
        odom = np.concatenate(list(own.values()))
    if not len(odom):
        return None, {"from": None, "outside": 0}
    poses, outside = [], 0
    for i, sensor in enumerate(sensors):
        if i in own:
            poses.append(own[i])
        else:
            at_scans, n_outside = trajectory.interpolate(odom_ns, odom, sensor.stamp_ns)
            poses.append(at_scans)
            outside += n_outside
    out = np.concatenate(poses)
    interpolated = "ODOM lines" if len(log.odom_stamp_ns) else "other lasers' scan lines"
    kinds = (["scan lines"] if own else []) + ([interpolated] if len(own) < len(sensors) else [])
    if outside:
        warnings.append(f"{outside} scans outside the time of the odometry: nearest pose")
    if len(out) > 1 and not _moves(out):
        warnings.append(
            advise("the odometry never moves", "if the robot did, map without odometry")
        )
    return out, {"from": " and ".join(kinds), "outside": outside}


def _moves(poses: NDArray[np.float64]) -> bool:
    return bool(np.any(poses != poses[0]))
