"""Which lasers of a bag are used, and where they sit on the robot."""

import numpy as np
from numpy.typing import NDArray

from stillmap.core.errors import InputError
from stillmap.io.builder import SkippedRecords
from stillmap.io.ros import base_frame
from stillmap.io.ros.collect import BagContent
from stillmap.io.ros.laser_scan import LaserScans
from stillmap.io.ros.topics import chosen_lasers
from stillmap.preprocessing.options import ReadOptions

_MANY = 0.05  # share of scans whose loss is worth a warning


def select_lasers(
    found: BagContent, options: ReadOptions
) -> tuple[
    list[LaserScans],
    list[NDArray[np.float64]],
    base_frame.SensorPoses,
    dict[str, SkippedRecords],
    list[str],
]:
    """The lasers to use, T_base_sensor at their scans, the robot's frame, what was skipped by
    topic, and words on the lasers that are left out."""
    lasers, skipped = found.lasers.finish()
    if not lasers:
        total = SkippedRecords().merge(*skipped.values())
        raise InputError(f"holds no usable laser scan: {total.summary('message')}")
    used, left_out = chosen_lasers(lasers, options.topic is not None)
    where = base_frame.find_base_frame(
        found.transforms, [s.frame for s in used], found.odometry, options
    )
    asked = [(s.frame, s.stamp_ns) for s in used]
    placed = base_frame.find_sensor_poses(found.transforms, where, asked)
    used, T, more = _connected(used, placed, given=options.base_frame is not None)
    left_out += more
    return used, T, placed, skipped, left_out


def _connected(
    lasers: list[LaserScans], placed: base_frame.SensorPoses, *, given: bool
) -> tuple[list[LaserScans], list[NDArray[np.float64]], list[str]]:
    """The lasers of which it is known where they sit on the robot, and words on the others."""
    used: list[LaserScans] = []
    T: list[NDArray[np.float64]] = []
    left_out = []
    for scans, found in zip(lasers, placed.T_base_sensor, strict=True):
        if found is None and given and not used:
            raise InputError(f"nothing says where {scans.frame!r} is in {placed.base!r}")
        if found is None and used:
            left_out.append(
                f"{scans.topic}: {scans.n_scans} scans, nothing says where {scans.frame!r} is on "
                f"the robot beside {used[0].frame!r} (--topic {scans.topic} takes it instead)"
            )
            continue
        used.append(scans)
        T.append(np.tile(np.eye(4), (scans.n_scans, 1, 1)) if found is None else found)
    return used, T, left_out


def loss_warning(kept: int, lost: SkippedRecords) -> list[str]:
    if lost.total <= _MANY * (kept + lost.total):
        return []
    return [
        f"{lost.total} of {kept + lost.total} scans are damaged and were skipped: "
        f"{lost.summary('message')}"
    ]
