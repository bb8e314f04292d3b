"""Selects the usable scans of each laser from the records of a CARMEN log."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.core.timestamps import longest_non_decreasing
from stillmap.io.carmen.log import CarmenLog, LaserLog
from stillmap.io.carmen.messages import SCAN_PARSERS, WRONG_COUNT

TIME_BACKWARDS = "time running backwards"
_KIND_ORDER = ("ROBOTLASER", "FLASER", "RLASER", "RAWLASER")  # preference for the same laser


def param_number(params: dict[str, str], name: str) -> float | None:
    """The PARAM of this name as a finite number; None if there is none."""
    try:
        value = float(params[name])
    except (KeyError, ValueError):
        return None
    return value if abs(value) < 1e6 else None


def laser_position(kind: str, params: dict[str, str]) -> str:
    """`front`, `rear` or the kind itself: kinds of the same position show the same laser."""
    if kind in ("FLASER", "ROBOTLASER1"):
        return "front"
    if kind in ("RLASER", "ROBOTLASER2"):
        return "rear"
    number = float(kind[-1])
    for place, default in (("front", 1.0), ("rear", 2.0)):
        stated = param_number(params, f"robot_{place}laser_id")
        if number == (default if stated is None else stated):
            return place
    return kind


@dataclass(frozen=True, eq=False)
class Sensor:
    """T usable scans of one laser with n beams each."""

    laser: LaserLog
    line: NDArray[np.int64]  # (T,) line numbers, from 1
    stamp_ns: NDArray[np.int64]  # (T,)
    ranges: NDArray[np.float32]  # (T, n)
    config: NDArray[np.int64]  # (T,) index into laser.configs
    poses: NDArray[np.float64] | None  # (T, 6) laser and robot pose on the scan lines


def select_scans(log: CarmenLog) -> tuple[list[Sensor], list[str]]:
    """The usable scans of each laser, and sentences on dropped kinds of lines.

    One kind of line per laser is used: newer logs hold each scan raw and with the robot's pose.
    """
    by_position: dict[str, list[LaserLog]] = {}
    for laser in log.lasers.values():
        position = laser_position(laser.kind, log.params)
        by_position.setdefault(position, []).append(laser)
    used, notes = [], []
    for same in by_position.values():
        most = max(len(laser.line) for laser in same)
        # a kind with only a few of the scans cannot replace the others
        complete = [laser for laser in same if 2 * len(laser.line) >= most]
        best = min(complete, key=lambda laser: _KIND_ORDER.index(laser.kind.rstrip("1234")))
        used.append(best)
        notes += [
            f"{laser.kind}: {len(laser.line)} scans not used, {best.kind} shows the same laser"
            for laser in same
            if laser is not best
        ]
    used.sort(key=lambda laser: list(SCAN_PARSERS).index(laser.kind.encode()))
    return [_select_usable_scans(laser, log) for laser in used], notes


def scan_order(sensors: list[Sensor]) -> NDArray[np.intp]:
    """(T,) indices that sort the concatenated scans of all sensors by stamp."""
    return np.argsort(np.concatenate([s.stamp_ns for s in sensors]), kind="stable")


def _select_usable_scans(laser: LaserLog, log: CarmenLog) -> Sensor:
    """The scans with the typical number of readings and non-decreasing stamps.

    The longest non-decreasing subsequence of the laser's stamps is kept, so that a stamp that jumps
    ahead costs one scan. Stamps of different lasers need not be in order.
    """
    count, line = np.asarray(laser.count), np.asarray(laser.line)
    shifted = np.asarray(laser.host_is_number, np.bool_)
    # a number in place of the host name: the fields before it are shifted
    usable = (count == laser.typical_count()) & ~(shifted & (shifted.mean() < 0.5))
    skipped = log.skipped_scans[laser.kind]
    skipped.add_all(WRONG_COUNT, line[~usable])
    scans = np.flatnonzero(usable)
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
