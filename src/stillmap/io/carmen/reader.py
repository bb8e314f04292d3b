"""CARMEN logs (`.log`, `.clf`, plain or gzip) as recordings.

Which scans of a CARMEN log become a recording.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.core.timestamps import longest_non_decreasing
from stillmap.io import trajectory
from stillmap.io.builder import SkippedRecords
from stillmap.io.carmen import extrinsics
from stillmap.io.carmen.extrinsics import Extrinsics
from stillmap.io.carmen.log import CarmenLog, LaserLog, read_log
from stillmap.io.carmen.messages import SCAN_PARSERS, WRONG_COUNT, flaser_config
from stillmap.io.text_lines import Progress, is_gzip
from stillmap.preprocessing import max_range
from stillmap.preprocessing.options import LaserOptions, ReadOptions

TIME_BACKWARDS = "time running backwards"

_PREFERRED = ("ROBOTLASER", "FLASER", "RLASER", "RAWLASER")  # of lines from the same laser


@dataclass(frozen=True, eq=False)
class Sensor:
    """The scans of one laser that are used; T of them with n beams each."""

    laser: LaserLog
    line: NDArray[np.int64]  # (T,) numbers of their lines, from 1
    stamp_ns: NDArray[np.int64]  # (T,)
    ranges: NDArray[np.float32]  # (T, n)
    config: NDArray[np.int64]  # (T,) into laser.configs
    poses: NDArray[np.float64] | None  # (T, 6) laser and robot pose on the scan lines


def select_scans(log: CarmenLog) -> tuple[list[Sensor], list[str]]:
    """The scans of each laser that become a recording, and which others show the same laser."""
    lasers, notes = _select_lasers(log)
    return [_select_usable_scans(laser, log) for laser in lasers], notes


def scan_order(sensors: list[Sensor]) -> NDArray[np.intp]:
    """(T,) the order of a recording's scans, of all sensors' scans one after the other."""
    return np.argsort(np.concatenate([s.stamp_ns for s in sensors]), kind="stable")


def _select_lasers(log: CarmenLog) -> tuple[list[LaserLog], list[str]]:
    """The lasers to use: newer CARMEN logs hold each scan twice, raw and with the robot's pose."""
    places: dict[str, list[LaserLog]] = {}
    for laser in log.lasers.values():
        places.setdefault(extrinsics.laser_position(laser.kind, log.params), []).append(laser)
    used, notes = [], []
    for same in places.values():
        most = max(len(laser.line) for laser in same)
        # a kind that holds only a few of the scans is no stand-in for the others
        whole = [laser for laser in same if 2 * len(laser.line) >= most]
        best = min(whole, key=lambda laser: _PREFERRED.index(laser.kind.rstrip("1234")))
        used.append(best)
        for other in same:
            if other is not best:
                notes.append(
                    f"{other.kind}: {len(other.line)} scans not used, "
                    f"{best.kind} shows the same laser"
                )
    return sorted(used, key=lambda laser: list(SCAN_PARSERS).index(laser.kind.encode())), notes


def _select_usable_scans(laser: LaserLog, log: CarmenLog) -> Sensor:
    """The scans with the usual number of readings whose time does not run backwards.

    Of a laser's stamps a longest non-decreasing subsequence is kept, so a stamp that jumps ahead
    costs one scan. Each laser is looked at alone: two of them may well report out of turn.
    """
    count, line = np.asarray(laser.count), np.asarray(laser.line)
    shifted = np.asarray(laser.host_is_number, np.bool_)
    # a number for a host where others have names: the fields before it are not what they seem
    usual = (count == laser.typical_count()) & ~(shifted & (shifted.mean() < 0.5))
    skipped = log.skipped_scans[laser.kind]
    skipped.add_all(WRONG_COUNT, line[~usual])
    scans = np.flatnonzero(usual)
    stamp_ns = np.asarray(laser.stamp_ns, np.int64)[scans]
    forward = longest_non_decreasing(stamp_ns.tolist())
    skipped.add_all(TIME_BACKWARDS, np.delete(line[scans], forward))
    scans = scans[forward]
    poses = np.asarray(laser.poses).reshape(-1, 6)[scans] if laser.has_poses else None
    return Sensor(
        laser,
        line[scans],
        stamp_ns[forward],
        laser.stack_readings(scans),
        np.asarray(laser.config)[scans],
        poses,
    )


_MANY = 0.05  # share of scans whose loss is worth a warning


def read(
    path: Path, options: ReadOptions | None = None, progress: Progress | None = None
) -> Recording:
    """Read a CARMEN log.

    Bad records are skipped and counted in `source["skipped"]` (scans) and
    `source["skipped_odometry"]`, by reason and with line numbers.

    Raises:
        InputError: the file cannot be read or holds no usable scan.
    """
    options = options or ReadOptions()
    log = read_log(path, progress)
    sensors, notes = select_scans(log)
    if not sensors:
        raise _no_scan(path, log)
    recording = _build_recording(sensors, log, options)
    recording.source.update(path=str(path), format="carmen", gzip=is_gzip(path))
    recording.source["duplicates"] = notes
    return recording


def _no_scan(path: Path, log: CarmenLog) -> InputError:
    kinds = ", ".join(name.decode() for name in SCAN_PARSERS)
    skipped = log.skipped.merge(*log.skipped_scans.values())
    if skipped.total:
        what = f"holds no usable laser scan: {skipped.summary()}"
    else:
        what = "holds no laser line" if log.n_lines else "is empty"
    return InputError(what, where=str(path), hint=f"a CARMEN log has lines of {kinds}")


def _build_recording(sensors: list[Sensor], log: CarmenLog, options: ReadOptions) -> Recording:
    """One recording of all lasers' scans in the order of their stamps."""
    options.check_laser_count(len(sensors))
    skipped = log.skipped.merge(*(log.skipped_scans[s.laser.kind] for s in sensors))
    warnings = _loss_warning(sensors, skipped)
    parts, places, infos = [], [], []
    for number, sensor in enumerate(sensors):
        place, more = extrinsics.find_extrinsics(sensor.laser, sensor.poses, log.params)
        given = options.laser(number)
        place = extrinsics.override(place, given)
        upside_down = extrinsics.find_upside_down(sensor.laser.kind, log.params, given)
        angles = _find_angles(sensor, log, given, upside_down[0], more)
        points, hit, rule = _convert_readings(sensor, angles, log, options, more)
        parts.append((points, hit))
        places.append(place)
        infos.append(_sensor_info(sensor, place, angles, upside_down, rule))
        warnings += more
    poses, odometry_info = _find_odometry(sensors, log)
    warnings += odometry_info.pop("warnings")
    sensor_of = np.repeat(np.arange(len(sensors)), [len(s.stamp_ns) for s in sensors])
    stamp_ns = np.concatenate([s.stamp_ns for s in sensors])
    order = scan_order(sensors)
    beams = np.array([s.ranges.shape[1] for s in sensors], np.int64)[sensor_of[order]]
    offset = np.concatenate([[0], np.cumsum(beams)]).astype(np.int64)
    points, hit = _interleave(parts, sensor_of[order], offset)
    return Recording(
        stamp_ns=stamp_ns[order],
        offset=offset,
        points=points,
        hit=hit,
        T_base_sensor=np.stack([place.matrix() for place in places]),
        sensor=sensor_of[order].astype(np.int32),
        T_odom_base=None if poses is None else se2.matrix(*poses[order].T),
        source={
            **_source(log, infos, odometry_info),
            "skipped": skipped.to_dict(),
            "warnings": warnings,
        },
    )


def _find_angles(
    sensor: Sensor, log: CarmenLog, given: LaserOptions, upside_down: bool, warnings: list[str]
) -> NDArray[np.float64]:
    """(C, 2) first angle and step in radians, counterclockwise, of each of the laser's configs."""
    angles = np.array([config[:2] for config in sensor.laser.configs])
    fov = extrinsics.find_field_of_view(sensor.laser.kind, log.params, given)
    if sensor.laser.kind in ("FLASER", "RLASER"):
        if fov is not None:
            angles[:] = flaser_config(sensor.ranges.shape[1], fov)[:2]
    elif given.fov is not None:
        text = "its lines state their angles: the given field of view is not used"
        warnings.append(f"{sensor.laser.kind}: {text}")
    return -angles if upside_down else angles


def _convert_readings(
    sensor: Sensor,
    angles: NDArray[np.float64],
    log: CarmenLog,
    options: ReadOptions,
    warnings: list[str],
) -> tuple[NDArray[np.float32], NDArray[np.bool_], max_range.RangeRule]:
    """End points (T, n, 2) in the sensor frame, hits (T, n), and how readings were understood."""
    declared = extrinsics.find_max_range(sensor.laser, log.params)
    rule, more = max_range.infer_range_rule(sensor.ranges, declared, options)
    more += _angle_warning(sensor)
    warnings += [f"{sensor.laser.kind}: {text}" for text in more]
    length, hit = max_range.apply_range_rule(sensor.ranges, rule)
    angle = angles[:, :1] + angles[:, 1:] * np.arange(length.shape[1])
    points = np.empty((*length.shape, 2), np.float32)
    points[..., 0] = length * np.cos(angle)[sensor.config]
    points[..., 1] = length * np.sin(angle)[sensor.config]
    return points, hit, rule


def _angle_warning(sensor: Sensor) -> list[str]:
    n = sensor.ranges.shape[1]
    for config in sensor.laser.configs:
        fan = n * config.angle_step  # or one step less: both are in use
        if config.field_of_view and abs(fan - config.field_of_view) > 3.0 * config.angle_step:
            return [
                f"{n} readings {np.degrees(config.angle_step):.3g} deg apart are not the stated "
                f"field of view of {np.degrees(config.field_of_view):.4g} deg"
            ]
    return []


def _interleave(
    parts: list[tuple[NDArray[np.float32], NDArray[np.bool_]]],
    sensor_of: NDArray[np.intp],
    offset: NDArray[np.int64],
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
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
    sensors: list[Sensor], log: CarmenLog
) -> tuple[NDArray[np.float64] | None, dict[str, Any]]:
    """Robot poses (T, 3) at the scans of all sensors, one sensor after the other.

    The pose on the scan line itself comes first; else the ODOM lines, else what other lasers'
    lines carry, are interpolated. Scan lines that repeat one pose while ODOM lines move carry
    none worth the name.
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
        return None, {"from": None, "outside": 0, "warnings": []}
    poses, outside = [], 0
    for i, sensor in enumerate(sensors):
        if i in own:
            poses.append(own[i])
        else:
            at_scans, missed = trajectory.interpolate(odom_ns, odom, sensor.stamp_ns)
            poses.append(at_scans)
            outside += missed
    out = np.concatenate(poses)
    interpolated = "ODOM lines" if len(log.odom_stamp_ns) else "other lasers' scan lines"
    kinds = (["scan lines"] if own else []) + ([interpolated] if len(own) < len(sensors) else [])
    warnings = (
        [f"{outside} scans outside the time of the odometry: nearest pose"] if outside else []
    )
    if len(out) > 1 and not _moves(out):
        warnings.append("the odometry never moves")
    return out, {"from": " and ".join(kinds), "outside": outside, "warnings": warnings}


def _moves(poses: NDArray[np.float64]) -> bool:
    return bool(np.any(poses != poses[0]))


def _loss_warning(sensors: list[Sensor], skipped: SkippedRecords) -> list[str]:
    kept = sum(len(sensor.stamp_ns) for sensor in sensors)
    lost = skipped.total
    if lost <= _MANY * (kept + lost):
        return []
    return [f"{lost} of {kept + lost} scans are damaged and were skipped: {skipped.summary()}"]


def _sensor_info(
    sensor: Sensor,
    place: Extrinsics,
    angles: NDArray[np.float64],
    upside_down: tuple[bool, str],
    rule: max_range.RangeRule,
) -> dict[str, Any]:
    first, step = angles[int(np.bincount(sensor.config).argmax())]
    return {
        "name": sensor.laser.kind,
        "scans": len(sensor.stamp_ns),
        "beams_per_scan": sensor.ranges.shape[1],
        "start_angle": float(first),
        "angle_step": float(step),
        "upside_down": upside_down[0],
        "upside_down_how": upside_down[1],
        "extrinsics": place.to_dict(),
        "ranges": rule.to_dict(),
    }


def _source(
    log: CarmenLog,
    sensors: list[dict[str, Any]],
    odometry_info: dict[str, Any],
) -> dict[str, Any]:
    used = {k: v for k, v in log.params.items() if k.startswith("robot_") and "laser" in k}
    return {
        "lines": log.n_lines,
        "records": dict(log.records),
        "ignored": dict(log.ignored),
        "sensors": sensors,
        "odometry": odometry_info,
        "params": used,
        "skipped_odometry": log.skipped_odometry.to_dict(),
    }
