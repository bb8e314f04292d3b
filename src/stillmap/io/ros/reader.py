"""Reads ROS bags as recordings, without ROS."""

import dataclasses
from collections.abc import Callable, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.core.advice import advise
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.core.timestamps import longest_non_decreasing
from stillmap.io.builder import ReadContext, SkippedRecords
from stillmap.io.ros import base_frame
from stillmap.io.ros.bag import JoinedBag, bag_size, open_parts
from stillmap.io.ros.bag_types import Bag, DamagedBagError
from stillmap.io.ros.collect import BagContent, collect_messages, select_topics
from stillmap.io.ros.laser_recording import build_laser_recording, build_tilting_recording
from stillmap.io.ros.laser_scan import TIME_BACKWARDS
from stillmap.io.ros.lent_transforms import lend_transforms
from stillmap.io.ros.limits import limit_output
from stillmap.io.ros.point_cloud2 import CloudCollector
from stillmap.prepare.options import ReadOptions

_BuildFromLasers = Callable[[BagContent, ReadContext], Recording]

_STILL = 1e-3  # m and entries of a rotation matrix: a sensor that moves less is fixed


def read(path: Path, context: ReadContext) -> Recording:
    """Read a bag: ROS 1, or a file or folder of ROS 2; see `read_parts`."""
    return read_parts([path], context)


def read_parts(
    paths: Sequence[Path],
    context: ReadContext,
    others: Sequence[Path] = (),
    build: _BuildFromLasers = build_laser_recording,
) -> Recording:
    """Read bags that are parts of one run as one.

    Bad messages are skipped and counted. A bag that is cut, damaged or without an index is read
    from the front as far as it goes.

    Args:
        paths: of the bags, in order of time.
        context: see ReadContext.
        others: bags that may be further parts: recorders write static transforms into the first
            part alone, so that one without any takes those of the part before.
        build: builds the recording of laser scans.

    Raises:
        InputError: one cannot be read, or they hold no usable scan.
    """
    path = paths[0]
    damage, size = "", sum(bag_size(one) for one in (*paths, *others))
    for trusted in (True, False):
        reopen = partial(_open, paths, others, context.scratch, trusted=trusted)
        try:
            with limit_output(size), closing(reopen()) as bag:
                recording = _build_recording(bag, context, reopen, build)
        except DamagedBagError as error:
            damage = str(error)
        except InputError as error:
            if damage and not error.where:
                what = f"{error.what}; it is damaged: {damage}"
                raise InputError(what, where=str(path), hint=error.hint) from error
            raise InputError(error.what, where=error.where or str(path), hint=error.hint) from error
        else:
            recording.source.update(path=str(path), format=bag.kind)
            if damage:
                reason = damage.rstrip(".")
                text = advise(
                    f"the bag is cut or damaged ({reason}): what could be read is used",
                    "copy it again; if it was recorded so, the map ends where the bag does",
                )
                recording.source["warnings"].insert(0, text)
            return recording
    raise InputError(f"is damaged: {damage}", where=str(path))


def _open(
    paths: Sequence[Path], others: Sequence[Path], scratch: Path | None, *, trusted: bool
) -> Bag:
    bag = open_parts(paths, scratch, trusted=trusted)
    return lend_transforms(bag, others, scratch) if others else bag


def read_tilting(path: Path, context: ReadContext) -> Recording:
    """Read the scans of a tilting laser; see `read_tilting_parts`."""
    return read_tilting_parts([path], context)


def read_tilting_parts(paths: Sequence[Path], context: ReadContext) -> Recording:
    """Read the scans of a laser that tilts or pans as 3D points, by the bag's transform tree.

    Args:
        paths: of the bag, or of its parts in order of time.
        context: the option `topic` names the scans, or clouds made from them; `base_frame` the
            robot.

    Raises:
        InputError: it cannot be read, or transforms do not say how the laser moves.
    """
    return read_parts(paths, context, build=build_tilting_recording)


def _build_recording(
    bag: Bag, context: ReadContext, reopen: Callable[[], Bag], build: _BuildFromLasers
) -> Recording:
    topics = select_topics(bag, context.options)
    content = collect_messages(bag, topics, context)
    if topics.has_clouds:
        recording = _build_cloud_recording(content, context.options, reopen)
    else:
        recording = build(content, context)
    recording.source.update(
        topics=topics.notes,
        skipped_unit="message",
        damage=bag.damage.to_dict(),
        skipped_odometry=content.skipped_odometry.to_dict(),
        **content.window.notes(),
    )
    if isinstance(bag, JoinedBag) and bag.repeated:
        text = f"{bag.repeated} messages that earlier parts hold already"
        recording.source["duplicates"].append(text)
    return recording


def _build_cloud_recording(
    content: BagContent, options: ReadOptions, reopen: Callable[[], Bag]
) -> Recording:
    """Build the 3D recording of all point clouds.

    Raises:
        InputError: none can be used.
    """
    clouds = content.clouds
    if not len(clouds.scans):
        total = SkippedRecords().merge(*clouds.skipped.values())
        raise InputError(f"holds no usable cloud: {total.summary('message')}")
    names = list(clouds.sensors)
    counts = np.bincount(np.asarray(clouds.scans.sensor), minlength=len(names)).tolist()
    used, omitted = _select_sensors(clouds, counts, named=options.topic is not None)
    stamps = np.asarray(clouds.scans.stamp_ns, np.int64)
    scans = [_select_forward_scans(clouds, names[k][0], k, stamps) for k in used]
    frames = [(names[k][1], stamps[rows]) for k, rows in zip(used, scans, strict=True)]
    poses = base_frame.find_sensor_poses(content, frames, options)
    T, selection, warnings = _place_sensors(poses, names, used, scans, options, omitted)
    odom, origin = base_frame.find_odometry(content, poses.base, stamps, options, warnings)
    skipped = SkippedRecords().merge(*clouds.skipped.values())
    sensors = [
        {"name": topic, "frame": frame, "scans": n}
        for (topic, frame), n in zip(names, counts, strict=True)
    ]
    recording = clouds.scans.build(
        T,
        selection=selection,
        T_odom_base=odom,
        images=content.window.select_images(
            content.images.build_images(content.transforms, poses.base, reopen)
        ),
        record=np.asarray(clouds.number, np.int64),
        source={
            "sensors": sensors,
            "base_frame": poses.base,
            "base_frame_how": poses.how,
            "odometry": origin,
            "skipped": skipped.to_dict(),
            "duplicates": omitted,
            "warnings": poses.warnings + warnings,
        },
    )
    timed = clouds.timed.intersection(used)
    return recording if timed else dataclasses.replace(recording, beam_time=None)


def _select_sensors(
    clouds: CloudCollector, counts: list[int], *, named: bool
) -> tuple[list[int], list[str]]:
    """The sensors to use, most points first: other clouds are derived from these."""
    names = list(clouds.sensors)
    sensor, beams = np.asarray(clouds.scans.sensor), np.asarray(clouds.scans.length)
    points = [int(beams[sensor == k].sum()) for k in range(len(names))]
    order = sorted(range(len(names)), key=lambda k: (-points[k], names[k]))
    candidates = [(*names[k], counts[k]) for k in order]
    chosen, omitted = base_frame.drop_duplicates(candidates, "clouds", named=named)
    return [order[k] for k in chosen], omitted


def _place_sensors(
    poses: base_frame.SensorPoses,
    names: list[tuple[str, str]],
    used: list[int],
    scans: list[NDArray[np.intp]],
    options: ReadOptions,
    omitted: list[str],
) -> tuple[NDArray[np.float64], NDArray[np.intp], list[str]]:
    """T_base_sensor (S, 4, 4), the scans of sensors with a known pose, and warnings.

    Sensors without one are added to `omitted`.
    """
    T = np.tile(np.eye(4), (len(names), 1, 1))
    kept: list[NDArray[np.intp]] = []
    topics: list[str] = []
    warnings = []
    for k, rows, found in zip(used, scans, poses.T_base_sensor, strict=True):
        topic, frame = names[k]
        if found is None and (kept or options.base_frame is not None):
            text = f"no transform connects {frame!r} with {poses.base!r}"
            if not kept:
                raise InputError(text)
            omitted.append(f"{topic}: {len(rows)} clouds, {text}")
            continue
        kept.append(rows)
        topics.append(topic)
        if found is not None:
            T[k] = found[0]
            if np.abs(found - found[0]).max() > _STILL:
                warnings.append(f"{topic}: the sensor moves on the robot: its first pose is used")
    base_frame.require_named_topics(topics, omitted, options)
    return T, np.sort(np.concatenate(kept)), warnings


def _select_forward_scans(
    clouds: CloudCollector, topic: str, sensor: int, stamps: NDArray[np.int64]
) -> NDArray[np.intp]:
    """The scans of a sensor with non-decreasing stamps; others are counted."""
    rows = np.flatnonzero(np.asarray(clouds.scans.sensor) == sensor)
    keep = longest_non_decreasing(stamps[rows].tolist())
    number = np.asarray(clouds.number)[rows]
    skipped = clouds.skipped.setdefault(topic, SkippedRecords())
    skipped.add_all(TIME_BACKWARDS, np.delete(number, keep))
    return rows[keep]
