"""Converts readings of laser scans to end points and hits, block by block."""

import dataclasses
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_builder import ArrayBuilder
from stillmap.core.arrays import release_pages, release_periodically
from stillmap.io.ros.laser_scan import LaserScans, ScanShape
from stillmap.prepare import max_range
from stillmap.prepare.options import MAX_PLAUSIBLE_RANGE, ReadOptions

_SAMPLE = 1 << 22  # readings from which the range rule is inferred
_BLOCK = 1 << 18  # beams at a time: these fit into the CPU caches
_MAX_NEAR_SHARE = 0.5  # of readings below range_min, beyond which range_min is ignored
_MAX_SCAN_TIME = 1.0  # s


class Beams(NamedTuple):
    """The beams of all scans of all lasers, ordered by the scans' stamps.

    Attributes:
        scan: (T,) index into the concatenated scans of the lasers.
        offset: (T+1,) int64.
        points: (M, 2) float32 in the sensor frame.
        hit: (M,) bool.
        beam_time: (M,) float32 seconds after the stamp, None without time increments.
    """

    scan: NDArray[np.intp]
    offset: NDArray[np.int64]
    points: NDArray[np.float32]
    hit: NDArray[np.bool_]
    beam_time: NDArray[np.float32] | None


def find_range_rule(
    scans: LaserScans, options: ReadOptions
) -> tuple[max_range.RangeRule, list[str]]:
    """The range rule of a laser, and warnings."""
    sample = _sample_readings(scans)
    shape = scans.typical_shape
    warnings = []
    nearest = shape.range_min if 0.0 < shape.range_min < MAX_PLAUSIBLE_RANGE else 0.0
    finite = sample[(sample >= max_range.MAX_ZERO_RANGE) & (sample < MAX_PLAUSIBLE_RANGE)]
    if finite.size and np.mean(finite < nearest) > _MAX_NEAR_SHARE:
        warnings.append(f"range_min {nearest:g} m is beyond most readings: ignored")
        nearest = 0.0
    nearest = max(nearest, options.min_range)
    declared = shape.range_max if 0.0 < shape.range_max < MAX_PLAUSIBLE_RANGE else None
    if declared is not None and declared <= nearest:
        declared = None
    rule, more = max_range.infer_range_rule(sample, declared, options)
    return dataclasses.replace(rule, min_range=nearest), warnings + more


def _sample_readings(scans: LaserScans) -> NDArray[np.float32]:
    """(K, n) readings of K scans evenly spread over the recording, padded with NaN."""
    lengths = scans.lengths
    # one long scan among many short ones makes all rows long: limit the padded size too
    wide = int(lengths.max(initial=1)) * scans.n_scans
    step = max(1, -(-int(lengths.sum()) // _SAMPLE), -(-wide // (4 * _SAMPLE)))
    chosen = np.arange(0, scans.n_scans, step)
    out = np.full((len(chosen), int(lengths[chosen].max(initial=1))), np.nan, np.float32)
    # the system reads pages around each scan: release them
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
    """Convert the readings of all lasers.

    Args:
        lasers: scans of each laser.
        rules: range rule of each laser.
        mirrored: whether each is mounted upside down, so that its angles change their sign.
        scratch: folder for memory-mapped buffers.
    """
    stamps = np.concatenate([scans.stamp_ns for scans in lasers])
    scan = np.argsort(stamps, kind="stable")
    lengths = np.concatenate([scans.lengths for scans in lasers])[scan]
    offset = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
    first = np.cumsum([0, *(scans.n_scans for scans in lasers)])
    laser = np.searchsorted(first, scan, side="right") - 1
    of_laser = scan - first[laser]  # index among the scans of its laser
    converters = [_BeamConverter(*one) for one in zip(lasers, rules, mirrored, strict=True)]
    points, hit = ArrayBuilder(np.float32, (2,), scratch), ArrayBuilder(np.bool_, (), scratch)
    timed = any(np.any(converter.steps) for converter in converters)
    times = ArrayBuilder(np.float32, (), scratch) if timed else None
    for begin, end in _split_into_runs(lasers, laser, of_laser):
        converter = converters[laser[begin]]
        its = slice(int(of_laser[begin]), int(of_laser[begin]) + end - begin)
        ends, hits = converter.beams(its)
        points.append(ends)
        hit.append(hits)
        if times is not None:
            times.append(converter.times(its))
    beam_time = None if times is None else times.finish()
    return Beams(scan, offset, points.finish(), hit.finish(), beam_time)


def _split_into_runs(
    lasers: list[LaserScans], laser: NDArray[np.intp], of_laser: NDArray[np.intp]
) -> Iterator[tuple[int, int]]:
    """(first, end) of runs of scans of one laser and shape with contiguous readings."""
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
        at_once = max(1, _BLOCK // max(int(length[begin]), 1))
        yield from ((at, min(at + at_once, end)) for at in range(begin, end, at_once))


def _per_scan(
    values: list[NDArray[Any]], laser: NDArray[np.intp], of_laser: NDArray[np.intp]
) -> NDArray[Any]:
    """(T,) values per scan of each laser, in the order of the recording."""
    out = np.empty(len(laser), np.int64)
    for number, its in enumerate(values):
        out[laser == number] = its[of_laser[laser == number]]
    return out


class _BeamConverter:
    """Converts the readings of one laser."""

    def __init__(self, scans: LaserScans, rule: max_range.RangeRule, mirror: bool) -> None:
        self._scans, self._rule, self._mirror = scans, rule, mirror
        self._typical_n = scans.typical_shape.n
        # the sectors of the self filter are beam numbers of typical scans
        self._unfiltered_rule = dataclasses.replace(rule, self_filter=())
        self.steps = _time_steps(scans)
        self._shape = -1  # of the directions
        self._directions = np.empty((0, 2), np.float32)

    def beams(self, run: slice) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Points (n, 2) and hits (n,) of a run of scans."""
        number = int(self._scans.shape[run.start])
        shape = self._scans.shapes[number]
        if number != self._shape:
            self._shape, self._directions = number, _directions(shape, self._mirror)
        start, n_scans = int(self._scans.start[run.start]), run.stop - run.start
        readings = self._scans.ranges[start : start + n_scans * shape.n].reshape(-1, shape.n)
        rule = self._rule if shape.n == self._typical_n else self._unfiltered_rule
        length, hit = max_range.apply_range_rule(readings, rule)
        points = np.empty((*length.shape, 2), np.float32)
        for axis in range(2):  # several times faster than one broadcast product
            np.multiply(length, self._directions[:, axis], out=points[..., axis])
        release_pages(self._scans.ranges)
        return points.reshape(-1, 2), hit.reshape(-1)

    def times(self, run: slice) -> NDArray[np.float32]:
        """(n,) beam times in seconds after the stamps."""
        shape = int(self._scans.shape[run.start])
        times = self.steps[shape] * np.arange(self._scans.shapes[shape].n)
        return np.tile(times.astype(np.float32), run.stop - run.start)


def _directions(shape: ScanShape, mirror: bool) -> NDArray[np.float32]:
    """(n, 2) unit vectors of the beams."""
    angle = -shape.angles() if mirror else shape.angles()
    return np.stack([np.cos(angle), np.sin(angle)], axis=1).astype(np.float32)


def _time_steps(scans: LaserScans) -> NDArray[np.float64]:
    """Seconds from beam to beam of each shape; 0 where missing or implausible."""
    period = 1.0 / scans.rate_hz if scans.rate_hz else _MAX_SCAN_TIME
    steps = np.array([s.time_increment for s in scans.shapes])
    duration = np.abs(steps) * np.array([max(s.n - 1, 1) for s in scans.shapes])
    # many drivers leave the field unset or wrong
    plausible = np.isfinite(steps) & (duration <= min(_MAX_SCAN_TIME, 1.5 * period))
    return np.where(plausible, steps, 0.0)
