"""ROS bags as recordings, without ROS.

The clouds of a bag as a 3D recording.
"""

import dataclasses
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.camera import Images
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.core.timestamps import longest_non_decreasing
from stillmap.io.builder import SkippedRecords
from stillmap.io.carmen import extrinsics
from stillmap.io.carmen.extrinsics import Extrinsics
from stillmap.io.ros import base_frame, scan_beams, tilting_laser
from stillmap.io.ros.bag import bag_size, open_bag
from stillmap.io.ros.bag_types import Bag, DamagedBagError
from stillmap.io.ros.collect import BagContent, collect_messages
from stillmap.io.ros.laser_scan import TIME_BACKWARDS, LaserScans
from stillmap.io.ros.limits import limit_output
from stillmap.io.ros.point_cloud2 import CloudCollector, select_sensors
from stillmap.io.ros.sensor_poses import loss_warning, select_lasers
from stillmap.io.ros.topics import select_topics
from stillmap.io.text_lines import Progress
from stillmap.preprocessing.options import ReadOptions

OfLasers = Callable[[BagContent, ReadOptions, Path | None], Recording]

ImagesOf = Callable[[str], Images | None]  # on a robot with this frame


def _build_cloud_recording(
    found: BagContent, options: ReadOptions, images_of: ImagesOf
) -> Recording:
    """The recording of all clouds that were read.

    Raises:
        InputError: none can be used.
    """
    topics = found.clouds
    if not len(topics.scans):
        total = SkippedRecords().merge(*topics.skipped.values())
        raise InputError(f"holds no usable cloud: {total.summary('message')}")
    used, left_out = select_sensors(topics, options.topic is not None)
    names = list(topics.sensors)
    stamps = np.asarray(topics.stamp_ns, np.int64)
    scans = [_select_forward_scans(topics, names[k][0], k, stamps) for k in used]
    where = base_frame.find_base_frame(
        found.transforms, [names[k][1] for k in used], found.odometry, options
    )
    asked = [(names[k][1], stamps[its]) for k, its in zip(used, scans, strict=True)]
    placed = base_frame.find_sensor_poses(found.transforms, where, asked)
    warnings = base_frame.base_frame_warnings(placed)
    T = np.tile(np.eye(4), (len(names), 1, 1))
    kept: list[NDArray[np.intp]] = []
    for k, its, on_robot in zip(used, scans, placed.T_base_sensor, strict=True):
        if on_robot is None and (kept or options.base_frame is not None):
            text = f"nothing says where {names[k][1]!r} is on the robot"
            if not kept:
                raise InputError(text)
            left_out.append(f"{names[k][0]}: {len(its)} clouds, {text}")
            continue
        kept.append(its)
        if on_robot is not None:
            T[k] = on_robot[0]
            if np.abs(on_robot - on_robot[0]).max() > 1e-3:
                warnings.append(f"{names[k][0]}: the sensor moves on the robot: its first place")
    chosen = np.sort(np.concatenate(kept))
    odom, told, more = base_frame.find_odometry(
        found.transforms, placed.base, found.odometry, stamps, options
    )
    skipped = SkippedRecords().merge(*topics.skipped.values())
    made = topics.scans.build(
        T,
        chosen=chosen,
        T_odom_base=odom,
        images=images_of(placed.base),
        source={
            "sensors": [
                {
                    "name": topic,
                    "frame": frame,
                    "scans": int(np.sum(np.asarray(topics.sensor) == k)),
                }
                for k, (topic, frame) in enumerate(names)
            ],
            "base_frame": placed.base,
            "base_frame_how": placed.how,
            "odometry": told,
            "skipped": skipped.to_dict(),
            "duplicates": left_out,
            "warnings": warnings + more,
        },
    )
    timed = topics.timed.intersection(used)
    return made if timed else dataclasses.replace(made, beam_time=None)


def _select_forward_scans(
    topics: CloudCollector, topic: str, sensor: int, stamps: NDArray[np.int64]
) -> NDArray[np.intp]:
    """The scans of a sensor whose time does not run backwards; others are counted."""
    its = np.flatnonzero(np.asarray(topics.sensor) == sensor)
    keep = longest_non_decreasing(stamps[its].tolist())
    number = np.asarray(topics.number)[its]
    topics.skipped.setdefault(topic, SkippedRecords()).add_all(
        TIME_BACKWARDS, np.delete(number, keep)
    )
    return its[keep]


_STILL = (1e-3, 1e-3)  # m, rad: a sensor that moves less on its robot does not


def read(
    path: Path, options: ReadOptions, progress: Progress | None, scratch: Path | None
) -> Recording:
    """Read a bag: ROS 1, or a file or folder of ROS 2.

    Bad messages are skipped and counted. A bag that is cut, damaged or without index is read from
    the front as far as it goes.

    Raises:
        InputError: it cannot be read, or holds no usable scan.
    """
    return _read(path, options, progress, scratch, _build_laser_recording)


def read_tilting(
    path: Path, options: ReadOptions, progress: Progress | None, scratch: Path | None
) -> Recording:
    """Read the scans of a laser that tilts or pans as points in 3D, by the transforms of a bag.

    Args:
        path: of the bag.
        options: `topic` names its scans, or clouds made from them; `base_frame` the robot.
        progress, scratch: as for any recording.

    Raises:
        InputError: it cannot be read, or nothing says how the laser moves.
    """
    return _read(path, options, progress, scratch, tilting_laser.build_tilting_recording)


def _read(
    path: Path,
    options: ReadOptions,
    progress: Progress | None,
    scratch: Path | None,
    of_lasers: OfLasers,
) -> Recording:
    damaged, size = "", bag_size(path)
    for trusted in (True, False):
        try:
            with limit_output(size), closing(open_bag(path, scratch, trusted=trusted)) as bag:
                recording = _build_recording(
                    bag,
                    options,
                    progress,
                    scratch,
                    partial(open_bag, path, scratch, trusted=trusted),
                    of_lasers,
                )
        except DamagedBagError as error:
            damaged = str(error)
        except InputError as error:
            if damaged and not error.where:
                what = f"{error.what}; it is damaged: {damaged}"
                raise InputError(what, where=str(path), hint=error.hint) from error
            raise InputError(error.what, where=error.where or str(path), hint=error.hint) from error
        else:
            recording.source.update(path=str(path), format=bag.kind)
            if damaged:
                said = (
                    f"the bag is cut or damaged ({damaged.rstrip('.')}): what could be read is used"
                )
                recording.source["warnings"].insert(0, said)
            return recording
    raise InputError(f"is damaged: {damaged}", where=str(path))


def list_scan_messages(
    bag: Bag, options: ReadOptions, scratch: Path | None
) -> list[tuple[str, int]]:
    """(T,) the topic and the number of the message, from 1, that each scan of a bag is.

    Raises:
        DamagedError: the bag is not whole.
        InputError: it holds no usable scan.
    """
    chosen = select_topics(bag, options)
    if chosen.clouds:
        raise InputError("holds point clouds: beams of laser scans alone can be blanked")
    found = collect_messages(bag, chosen, options, None, scratch)
    used = select_lasers(found, options)[0]
    stamps = np.concatenate([scans.stamp_ns for scans in used])
    all_of_them = [(scans.topic, int(number)) for scans in used for number in scans.number]
    return [all_of_them[scan] for scan in np.argsort(stamps, kind="stable")]


def _build_recording(
    bag: Bag,
    options: ReadOptions,
    progress: Progress | None,
    scratch: Path | None,
    reopened: Callable[[], Bag],
    of_lasers: OfLasers,
) -> Recording:
    chosen = select_topics(bag, options)
    found = collect_messages(bag, chosen, options, progress, scratch)
    if chosen.clouds:
        recording = _build_cloud_recording(
            found,
            options,
            lambda base: found.images.build_images(found.transforms, base, reopened),
        )
    else:
        recording = of_lasers(found, options, scratch)
    recording.source.update(
        topics=chosen.notes,
        skipped_unit="message",
        damage=bag.damage.to_dict(),
        skipped_odometry=found.skipped_odometry.to_dict(),
    )
    return recording


def _build_laser_recording(
    found: BagContent, options: ReadOptions, scratch: Path | None
) -> Recording:
    used, T, placed, skipped, left_out = select_lasers(found, options)
    options.check_laser_count(len(used))
    warnings = [w for s in used for w in s.warnings] + base_frame.base_frame_warnings(placed)
    T_base_sensor, sensor, mirrored, infos, more = _find_mountings(used, T, placed, options)
    warnings += more
    rules = []
    for scans, info in zip(used, infos, strict=True):
        rule, more = scan_beams.find_range_rule(scans, options)
        info["ranges"] = rule.to_dict()
        rules.append(rule)
        warnings += [f"{scans.topic}: {text}" for text in more]
    all_beams = scan_beams.convert_to_beams(used, rules, mirrored, scratch)
    stamp_ns = np.concatenate([s.stamp_ns for s in used])[all_beams.scan]
    odom, told, more = base_frame.find_odometry(
        found.transforms, placed.base, found.odometry, stamp_ns, options
    )
    lost = SkippedRecords().merge(*(skipped[topic] for topic in {s.topic for s in used}))
    warnings += more + loss_warning(sum(s.n_scans for s in used), lost)
    return Recording(
        stamp_ns=stamp_ns,
        offset=all_beams.offset,
        points=all_beams.points,
        hit=all_beams.hit,
        T_base_sensor=T_base_sensor,
        sensor=sensor[all_beams.scan],
        T_odom_base=None if odom is None else base_frame.project_to_plane(odom)[0],
        beam_time=all_beams.beam_time,
        source={
            "sensors": infos,
            "base_frame": placed.base,
            "base_frame_how": placed.how,
            "odometry": told,
            "skipped": lost.to_dict(),
            "duplicates": left_out,
            "warnings": warnings,
        },
    )


def _find_mountings(
    lasers: list[LaserScans],
    T: list[NDArray[np.float64]],
    placed: base_frame.SensorPoses,
    options: ReadOptions,
) -> tuple[NDArray[np.float64], NDArray[np.int32], list[bool], list[dict[str, Any]], list[str]]:
    """Where the lasers sit, seen from above.

    Returns:
        (S, 3, 3) T_base_sensor; (T,) int32 which of them each scan has, the scans of one laser
        after those of another; whether each laser's beams are turned round; notes on each laser;
        warnings. A laser that moves on its robot has a place for every scan.
    """
    places, sensor, mirrored, infos, warnings = [], [], [], [], []
    count = 0
    for number, (scans, on_robot) in enumerate(zip(lasers, T, strict=True)):
        flat, upside_down, tilts = base_frame.project_to_plane(on_robot)
        given = options.laser(number)
        if tilts:
            warnings.append(f"{scans.topic}: the laser is tilted; its scans are taken for level")
        if not _moves(flat) or given.pose != (None, None, None):
            flat = flat[:1]
            x, y, theta = se2.parameters(flat)[0].tolist()
            place = extrinsics.override(
                Extrinsics(x, y, theta, _describe_extrinsics(scans, placed)), given
            )
            flat = place.matrix()[None]
        else:
            x, y, theta = se2.parameters(flat)[0].tolist()
            place = Extrinsics(x, y, theta, "TF, it moves: at its first scan")
        how = "given" if given.upside_down is not None else "TF"
        upside_down = upside_down if given.upside_down is None else given.upside_down
        its = np.arange(scans.n_scans) if len(flat) > 1 else np.zeros(scans.n_scans)
        places.append(flat)
        sensor.append((its + count).astype(np.int32))
        mirrored.append(upside_down)
        infos.append({**_describe_sensor(scans, place, upside_down, how), "places": len(flat)})
        count += len(flat)
    return np.concatenate(places), np.concatenate(sensor), mirrored, infos, warnings


def _moves(flat: NDArray[np.float64]) -> bool:
    metres, radians = _STILL
    away = se2.parameters(se2.inverse(flat[:1]) @ flat)
    return bool(np.abs(away[:, :2]).max() > metres or np.abs(away[:, 2]).max() > radians)


def _describe_extrinsics(scans: LaserScans, placed: base_frame.SensorPoses) -> str:
    if scans.frame == placed.base:
        return "the laser is the robot's frame"
    return f"TF from {placed.base} to {scans.frame}"


def _describe_sensor(
    scans: LaserScans, place: Extrinsics, upside_down: bool, how: str
) -> dict[str, Any]:
    usual = scans.typical_shape
    sign = -1.0 if upside_down else 1.0
    return {
        "name": scans.topic,
        "frame": scans.frame,
        "scans": scans.n_scans,
        "beams_per_scan": usual.n,
        "start_angle": sign * usual.angle_min,
        "angle_step": sign * usual.angle_increment,
        "upside_down": upside_down,
        "upside_down_how": how,
        "extrinsics": place.to_dict(),
    }
