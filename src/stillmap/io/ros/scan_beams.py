"""From readings to beams: end points and hits, a piece of the recording at a time."""

import dataclasses
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import ArrayBuilder, release_pages, release_periodically
from stillmap.io.ros.laser_scan import LaserScans, ScanShape
from stillmap.preprocessing import max_range
from stillmap.preprocessing.options import MAX_PLAUSIBLE_RANGE, ReadOptions

_SAMPLE = 1 << 22  # readings that tell how readings are to be understood
_PIECE = 1 << 18  # beams at a time: what they need stays in the caches
_MOST = 0.5  # share of a laser's readings that its own range_min cannot be meant to refuse
_LONGEST = 1.0  # s that a scan may take


class Beams(NamedTuple):
    """The beams of all scans of all lasers, in the order of the scans' stamps.

    Attributes:
        scan: (T,) which of the lasers' scans each is, the lasers' one after the other.
        offset: (T+1,) int64.
        points: (M, 2) float32 in the sensor frame.
        hit: (M,) bool.
        beam_time: (M,) float32 seconds after the stamp, None if no laser tells.
    """

    scan: NDArray[np.intp]
    offset: NDArray[np.int64]
    points: NDArray[np.float32]
    hit: NDArray[np.bool_]
    beam_time: NDArray[np.float32] | None


def find_range_rule(
    scans: LaserScans, options: ReadOptions
) -> tuple[max_range.RangeRule, list[str]]:
    """How a laser's readings are understood, and warnings in words."""
    sample = _sample_readings(scans)
    usual = scans.typical_shape
    warnings = []
    nearest = usual.range_min if 0.0 < usual.range_min < MAX_PLAUSIBLE_RANGE else 0.0
    finite = sample[(sample >= max_range.MAX_ZERO_RANGE) & (sample < MAX_PLAUSIBLE_RANGE)]
    if finite.size and np.mean(finite < nearest) > _MOST:
        warnings.append(f"range_min {nearest:g} m is beyond most readings: not heeded")
        nearest = 0.0
    nearest = max(nearest, options.min_range)
    declared = usual.range_max if 0.0 < usual.range_max < MAX_PLAUSIBLE_RANGE else None
    if declared is not None and declared <= nearest:
        declared = None
    rule, more = max_range.infer_range_rule(sample, declared, options)
    return dataclasses.replace(rule, min_range=nearest), warnings + more


def _sample_readings(scans: LaserScans) -> NDArray[np.float32]:
    """(K, n) readings of scans evenly spread over the recording; short ones end in NaN."""
    lengths = scans.lengths
    # one long scan among many short ones makes all rows long
    wide = int(lengths.max(initial=1)) * scans.n_scans
    step = max(1, -(-int(lengths.sum()) // _SAMPLE), -(-wide // (4 * _SAMPLE)))
    chosen = np.arange(0, scans.n_scans, step)
    out = np.full((len(chosen), int(lengths[chosen].max(initial=1))), np.nan, np.float32)
    # a few of many: around each that is looked at the system maps a good deal more
    for k, t in enumerate(
        release_periodically(chosen.tolist(), lambda: release_pages(scans.ranges))
    ):
        out[k, : lengths[t]] = scans.ranges[scans.start[t] : scans.start[t] + lengths[t]]
    return out


def convert_to_beams(
    lasers: list[LaserScans],
    rules: list[max_range.RangeRule],
    mirrored: list[bool],
    scratch: Path | None,
) -> Beams:
    """Beams of all lasers.

    Args:
        lasers: their scans.
        rules: how the readings of each are understood.
        mirrored: whether each hangs upside down, so that its beams turn the other way round.
        scratch: folder for what does not fit into memory.
    """
    stamps = np.concatenate([scans.stamp_ns for scans in lasers])
    scan = np.argsort(stamps, kind="stable")
    lengths = np.concatenate([scans.lengths for scans in lasers])[scan]
    offset = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
    first = np.cumsum([0, *(scans.n_scans for scans in lasers)])
    laser = np.searchsorted(first, scan, side="right") - 1
    of_laser = scan - first[laser]  # which of its laser's scans each is
    makers = [_BeamConverter(*one) for one in zip(lasers, rules, mirrored, strict=True)]
    points, hit = ArrayBuilder(np.float32, (2,), scratch), ArrayBuilder(np.bool_, (), scratch)
    timed = any(np.any(maker.steps) for maker in makers)
    times = ArrayBuilder(np.float32, (), scratch) if timed else None
    for begin, end in _split_into_runs(lasers, laser, of_laser):
        maker = makers[laser[begin]]
        its = slice(int(of_laser[begin]), int(of_laser[begin]) + end - begin)
        ends, hits = maker.beams(its)
        points.append(ends)
        hit.append(hits)
        if times is not None:
            times.append(maker.times(its))
    beam_time = None if times is None else times.finish()
    return Beams(scan, offset, points.finish(), hit.finish(), beam_time)


def _split_into_runs(
    lasers: list[LaserScans], laser: NDArray[np.intp], of_laser: NDArray[np.intp]
) -> Iterator[tuple[int, int]]:
    """Scans in a row, in pieces: first and end, of one laser and shape, their readings together."""
    start, shape, length = (
        _per_scan([getattr(scans, name) for scans in lasers], laser, of_laser)
        for name in ("start", "shape", "lengths")
    )
    follows = (
        (laser[1:] == laser[:-1])
        & (of_laser[1:] == of_laser[:-1] + 1)
        & (shape[1:] == shape[:-1])
        & (start[1:] == start[:-1] + length[:-1])
    )
    for begin, end in itertools.pairwise([0, *(np.flatnonzero(~follows) + 1).tolist(), len(laser)]):
        at_once = max(1, _PIECE // max(int(length[begin]), 1))
        yield from ((at, min(at + at_once, end)) for at in range(begin, end, at_once))


def _per_scan(
    values: list[NDArray[Any]], laser: NDArray[np.intp], of_laser: NDArray[np.intp]
) -> NDArray[Any]:
    """(T,) values of the lasers' scans in the order of the recording."""
    out = np.empty(len(laser), np.int64)
    for number, its in enumerate(values):
        out[laser == number] = its[of_laser[laser == number]]
    return out


class _BeamConverter:
    """Makes beams of one laser's readings."""

    def __init__(self, scans: LaserScans, rule: max_range.RangeRule, mirror: bool) -> None:
        self._scans, self._rule, self._mirror = scans, rule, mirror
        self._usual = scans.typical_shape.n
        # which beams meet the robot is known of scans as most are
        self._other = dataclasses.replace(rule, self_filter=())
        self.steps = _time_steps(scans)
        self._shape = -1
        self._directions = np.empty((0, 2), np.float32)

    def beams(self, its: slice) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Points (n, 2) and hits (n,) of scans of one shape whose readings lie together."""
        n = self._turned_to(its)
        at = int(self._scans.start[its.start])
        readings = self._scans.ranges[at : at + (its.stop - its.start) * n].reshape(-1, n)
        length, hit = max_range.apply_range_rule(
            readings, self._rule if n == self._usual else self._other
        )
        points = np.empty((*length.shape, 2), np.float32)
        for axis in range(2):  # several times faster than one product of all
            np.multiply(length, self._directions[:, axis], out=points[..., axis])
        release_pages(self._scans.ranges)
        return points.reshape(-1, 2), hit.reshape(-1)

    def times(self, its: slice) -> NDArray[np.float32]:
        """(n,) seconds after their scans' stamps."""
        shape = int(self._scans.shape[its.start])
        one = self.steps[shape] * np.arange(self._scans.shapes[shape].n)
        return np.tile(one.astype(np.float32), its.stop - its.start)

    def _turned_to(self, its: slice) -> int:
        shape = int(self._scans.shape[its.start])
        if shape != self._shape:
            self._shape = shape
            self._directions = _directions(self._scans.shapes[shape], self._mirror)
        return self._scans.shapes[shape].n


def _directions(shape: ScanShape, mirror: bool) -> NDArray[np.float32]:
    """(n, 2) unit vectors of the beams."""
    angle = -shape.angles() if mirror else shape.angles()
    return np.stack([np.cos(angle), np.sin(angle)], axis=1).astype(np.float32)


def _time_steps(scans: LaserScans) -> NDArray[np.float64]:
    """Seconds between two beams, for each shape; 0 where none are told or none can be meant."""
    period = 1.0 / scans.rate_hz if scans.rate_hz else _LONGEST
    steps = np.array([s.time_increment for s in scans.shapes])
    takes = np.abs(steps) * np.array([max(s.n - 1, 1) for s in scans.shapes])
    # drivers that leave the field unset or fill it wrongly are many
    fine = np.isfinite(steps) & (takes <= min(_LONGEST, 1.5 * period))
    return np.where(fine, steps, 0.0)
