"""Which scans of a CARMEN log become a recording."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.recording import extrinsics
from stillmap.recording.carmen_log import CarmenLog, LaserLog
from stillmap.recording.carmen_messages import SCAN_PARSERS, WRONG_COUNT
from stillmap.recording.stamps import longest_non_decreasing

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


def used(log: CarmenLog) -> tuple[list[Sensor], list[str]]:
    """The scans of each laser that become a recording, and which others show the same laser."""
    lasers, notes = _one_kind_per_laser(log)
    return [_usable(laser, log) for laser in lasers], notes


def in_order(sensors: list[Sensor]) -> NDArray[np.intp]:
    """(T,) the order of a recording's scans, of all sensors' scans one after the other."""
    return np.argsort(np.concatenate([s.stamp_ns for s in sensors]), kind="stable")


def _one_kind_per_laser(log: CarmenLog) -> tuple[list[LaserLog], list[str]]:
    """The lasers to use: newer CARMEN logs hold each scan twice, raw and with the robot's pose."""
    places: dict[str, list[LaserLog]] = {}
    for laser in log.lasers.values():
        places.setdefault(extrinsics.position(laser.kind, log.params), []).append(laser)
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


def _usable(laser: LaserLog, log: CarmenLog) -> Sensor:
    """The scans with the usual number of readings whose time does not run backwards.

    Of a laser's stamps a longest non-decreasing subsequence is kept, so a stamp that jumps ahead
    costs one scan. Each laser is looked at alone: two of them may well report out of turn.
    """
    count, line = np.asarray(laser.count), np.asarray(laser.line)
    shifted = np.asarray(laser.host_is_number, np.bool_)
    # a number for a host where others have names: the fields before it are not what they seem
    usual = (count == laser.usual_count()) & ~(shifted & (shifted.mean() < 0.5))
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
        laser.readings(scans),
        np.asarray(laser.config)[scans],
        poses,
    )
