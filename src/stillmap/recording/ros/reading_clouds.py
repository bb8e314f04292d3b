"""The clouds of a bag as a 3D recording."""

import dataclasses
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from stillmap.errors import InputError
from stillmap.recording.images import Images
from stillmap.recording.model import Recording
from stillmap.recording.options import ReadOptions
from stillmap.recording.ros import base
from stillmap.recording.ros.clouds import CloudTopics, chosen_scans
from stillmap.recording.ros.gathered import Content
from stillmap.recording.ros.lasers import TIME_BACKWARDS
from stillmap.recording.skipped import Skipped
from stillmap.recording.stamps import longest_non_decreasing

ImagesOf = Callable[[str], Images | None]  # on a robot with this frame


def recording(found: Content, options: ReadOptions, images_of: ImagesOf) -> Recording:
    """The recording of all clouds that were read.

    Raises:
        InputError: none can be used.
    """
    topics = found.clouds
    if not len(topics.scans):
        total = Skipped().merged(*topics.skipped.values())
        raise InputError(f"holds no usable cloud: {total.summary('message')}")
    used, left_out = chosen_scans(topics, options.topic is not None)
    names = list(topics.sensors)
    stamps = np.asarray(topics.stamp_ns, np.int64)
    scans = [_forward(topics, names[k][0], k, stamps) for k in used]
    where = base.base_frame(found.transforms, [names[k][1] for k in used], found.odometry, options)
    asked = [(names[k][1], stamps[its]) for k, its in zip(used, scans, strict=True)]
    placed = base.places(found.transforms, where, asked)
    warnings = base.words(placed)
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
    odom, told, more = base.odometry_at(
        found.transforms, placed.base, found.odometry, stamps, options
    )
    skipped = Skipped().merged(*topics.skipped.values())
    made = topics.scans.recording(
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


def _forward(
    topics: CloudTopics, topic: str, sensor: int, stamps: NDArray[np.int64]
) -> NDArray[np.intp]:
    """The scans of a sensor whose time does not run backwards; others are counted."""
    its = np.flatnonzero(np.asarray(topics.sensor) == sensor)
    keep = longest_non_decreasing(stamps[its].tolist())
    number = np.asarray(topics.number)[its]
    topics.skipped.setdefault(topic, Skipped()).add_all(TIME_BACKWARDS, np.delete(number, keep))
    return its[keep]
