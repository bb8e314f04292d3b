"""Raw scans of planar lasers, and the recording that the range rules make of them."""

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays
from stillmap.core.array_builder import ArrayBuilder
from stillmap.core.array_types import Bool, Float, Float32, Index, Int64
from stillmap.core.arrays import release_pages, release_periodically
from stillmap.core.recording import Recording
from stillmap.core.source import RangeRule, Source
from stillmap.prepare import max_range
from stillmap.prepare.options import MAX_PLAUSIBLE_RANGE, ReadOptions

SAMPLE = 1 << 22  # readings from which the range rule is inferred
_BLOCK = 1 << 18  # beams at a time: these fit into the CPU caches
_MAX_NEAR_SHARE = 0.5  # of readings below the stated minimum, beyond which it is ignored


@dataclass(frozen=True, eq=False)
class RawLaser:
    """T scans of one laser, ordered by their stamps.

    Attributes:
        name: for warnings; "": none.
        stamp_ns: (T,) int64.
        ranges: (N,) float32 readings of all scans in metres; may be memory-mapped.
        start: (T,) int64 index of the first reading of each scan.
        shape: (T,) index into `directions`.
        directions: (n, 2) unit vectors of the beams in each geometry; end points are computed in
            their type.
        beam_steps: s from beam to beam in each geometry; (): all beams have the stamp.
        min_range, max_range: m, as the recording states them; None: it does not.
        sample: readings from which the range rule is inferred.
    """

    name: str
    stamp_ns: Int64
    ranges: Float32
    start: Int64
    shape: NDArray[np.integer[Any]]
    directions: list[NDArray[np.floating[Any]]]
    beam_steps: tuple[float, ...] = ()
    min_range: float = 0.0
    max_range: float | None = None
    sample: int = SAMPLE

    @cached_property
    def lengths(self) -> Int64:
        """(T,) number of beams of each scan."""
        return np.asarray(np.array([len(d) for d in self.directions], np.int64)[self.shape])

    @cached_property
    def typical_shape(self) -> int:
        """The most frequent geometry with as many beams as most scans."""
        usual = np.bincount(self.lengths, minlength=1).argmax()
        return int(np.bincount(self.shape[self.lengths == usual], minlength=1).argmax())

    def sample_readings(self) -> Float32:
        """(K, n) readings of K scans evenly spread over the recording, padded with NaN."""
        lengths, T = self.lengths, len(self.stamp_ns)
        # a long scan among many short ones makes all rows long: limit the padded size too
        wide = int(lengths.max(initial=1)) * T
        step = max(1, -(-int(lengths.sum()) // self.sample), -(-wide // (4 * self.sample)))
        chosen = np.arange(0, T, step)
        out = np.full((len(chosen), int(lengths[chosen].max(initial=1))), np.nan, np.float32)
        scans = release_periodically(chosen.tolist(), lambda: release_pages(self.ranges))
        for k, t in enumerate(scans):
            out[k, : lengths[t]] = self.ranges[self.start[t] : self.start[t] + lengths[t]]
        return out


@dataclass(frozen=True, eq=False)
class RawLasers:
    """The lasers of a recording of T scans.

    Attributes:
        lasers: their scans.
        mounts: of each T_base_sensor (1, 3, 3), or (T, 3, 3) where it moves on the robot.
        T_odom_base: (T, 3, 3) in the order of `scan_order`; None: no odometry.
        source: notes of the reader; `sensors` of each laser.
        record: (T,) in the order of `scan_order`; see Recording.
        to_3d: of a laser that tilts, whose mounts are (T, 4, 4): end points (M, 3), NaN where
            the tilt is not known, and warnings.
    """

    lasers: list[RawLaser]
    mounts: list[Float]
    T_odom_base: Float | None
    source: Source
    record: Int64 | None = None
    to_3d: "Callable[[Beams], tuple[Float32, list[str]]] | None" = None


def scan_order(lasers: list[RawLaser]) -> Index:
    """(T,) indices that sort the concatenated scans of all lasers by stamp."""
    return np.argsort(np.concatenate([laser.stamp_ns for laser in lasers]), kind="stable")


def unit_vectors(angles: Float) -> Float:
    """(n, 2) directions of angles (n,) in radians."""
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


def place_beams(raw: RawLasers, options: ReadOptions, scratch: Path | None) -> Recording:
    """The recording of all lasers, ordered by stamps.

    The readings show which of them are hits (`max_range`); `source` keeps the rule of each laser.
    """
    warnings, notes, rules = list(raw.source.warnings), [], []
    for laser, known in zip(raw.lasers, raw.source.sensors, strict=True):
        rule, texts = find_range_rule(laser, options)
        warnings += [f"{laser.name}: {text}" if laser.name else text for text in texts]
        notes.append(replace(known, ranges=rule))
        rules.append(rule)
    beams = convert_to_beams(raw.lasers, rules, scratch)
    sensors, first = [], 0
    for laser, mount in zip(raw.lasers, raw.mounts, strict=True):
        own = np.arange(len(laser.stamp_ns)) if len(mount) > 1 else np.zeros(len(laser.stamp_ns))
        sensors.append((first + own).astype(np.int32))
        first += len(mount)
    points, hit = beams.points, beams.hit
    if raw.to_3d is not None:
        points, texts = raw.to_3d(beams)
        hit, warnings = hit & ~np.isnan(points[:, 0]), warnings + texts
    return Recording(
        stamp_ns=np.concatenate([laser.stamp_ns for laser in raw.lasers])[beams.scan],
        offset=beams.offset,
        points=points,
        hit=hit,
        T_base_sensor=np.concatenate(raw.mounts),
        sensor=np.concatenate(sensors)[beams.scan],
        T_odom_base=raw.T_odom_base,
        beam_time=beams.beam_time,
        record=raw.record,
        source=replace(raw.source, sensors=notes, warnings=warnings),
    )


def find_range_rule(laser: RawLaser, options: ReadOptions) -> tuple[RangeRule, list[str]]:
    """The range rule of a laser, and warnings."""
    sample, warnings = laser.sample_readings(), []
    nearest = laser.min_range if 0.0 < laser.min_range < MAX_PLAUSIBLE_RANGE else 0.0
    finite = sample[(sample >= max_range.MAX_ZERO_RANGE) & (sample < MAX_PLAUSIBLE_RANGE)]
    if finite.size and np.mean(finite < nearest) > _MAX_NEAR_SHARE:
        warnings.append(f"range_min {nearest:g} m is beyond most readings: ignored")
        nearest = 0.0
    nearest = max(nearest, options.min_range)
    declared = laser.max_range
    if declared is not None and not nearest < declared < MAX_PLAUSIBLE_RANGE:
        declared = None
    rule, more = max_range.infer_range_rule(sample, declared, options)
    return replace(rule, min_range=nearest), warnings + more


class Beams(NamedTuple):
    """The beams of all scans of all lasers, ordered by the scans' stamps.

    Attributes:
        scan: (T,) index into the concatenated scans of the lasers.
        offset: (T+1,) int64.
        points: (M, 2) float32 in the sensor frame.
        hit: (M,) bool.
        beam_time: (M,) float32 seconds after the stamp, None without time increments.
    """

    scan: Index
    offset: Int64
    points: Float32
    hit: Bool
    beam_time: Float32 | None


def convert_to_beams(lasers: list[RawLaser], rules: list[RangeRule], scratch: Path | None) -> Beams:
    """End points and hits of the readings of all lasers, by the range rule of each."""
    scan = scan_order(lasers)
    lengths = np.concatenate([laser.lengths for laser in lasers])[scan]
    first = np.cumsum([0, *(len(laser.stamp_ns) for laser in lasers)])
    laser_of = np.searchsorted(first, scan, side="right") - 1
    number = scan - first[laser_of]  # among the scans of its laser
    points, hit = ArrayBuilder(np.float32, (2,), scratch), ArrayBuilder(np.bool_, (), scratch)
    timed = any(np.any(laser.beam_steps) for laser in lasers)
    times = ArrayBuilder(np.float32, (), scratch) if timed else None
    for begin, end in _split_into_runs(lasers, laser_of, number):
        laser, rule = lasers[laser_of[begin]], rules[laser_of[begin]]
        run = slice(int(number[begin]), int(number[begin]) + end - begin)
        ends, hits = _convert_run(laser, rule, run)
        points.append(ends)
        hit.append(hits)
        if times is not None:
            shape = int(laser.shape[run.start])
            step = laser.beam_steps[shape] if laser.beam_steps else 0.0
            of_scan = (step * np.arange(len(laser.directions[shape]))).astype(np.float32)
            times.append(np.tile(of_scan, end - begin))
    beam_time = None if times is None else times.finish()
    offset = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
    return Beams(scan, offset, points.finish(), hit.finish(), beam_time)


def _split_into_runs(
    lasers: list[RawLaser], laser_of: Index, number: Index
) -> Iterator[tuple[int, int]]:
    """(first, end) of runs of scans of one laser and geometry with contiguous readings."""
    start, shape, length = np.empty((3, len(laser_of)), np.int64)
    for k, laser in enumerate(lasers):
        own, rows = laser_of == k, number[laser_of == k]
        start[own], shape[own] = laser.start[rows], laser.shape[rows]
        length[own] = laser.lengths[rows]
    follows = (
        (laser_of[1:] == laser_of[:-1])
        & (number[1:] == number[:-1] + 1)
        & (shape[1:] == shape[:-1])
        & (start[1:] == start[:-1] + length[:-1])
    )
    cuts = [0, *(np.flatnonzero(~follows) + 1).tolist(), len(laser_of)]
    for begin, end in itertools.pairwise(cuts):
        at_once = max(1, _BLOCK // max(int(length[begin]), 1))
        yield from ((at, min(at + at_once, end)) for at in range(begin, end, at_once))


def _convert_run(laser: RawLaser, rule: RangeRule, run: slice) -> tuple[Float32, Bool]:
    """Points (n, 2) and hits (n,) of a run of scans."""
    directions = laser.directions[laser.shape[run.start]]
    n, start = len(directions), int(laser.start[run.start])
    readings = laser.ranges[start : start + (run.stop - run.start) * n].reshape(-1, n)
    if n != len(laser.directions[laser.typical_shape]):
        # the sectors of the self filter are beam numbers of typical scans
        rule = replace(rule, self_filter=())
    length, hit = max_range.apply_range_rule(readings, rule)
    points = np.empty((*length.shape, 2), np.float32)
    for axis in range(2):  # several times faster than one broadcast product
        np.multiply(length, directions[:, axis], out=points[..., axis], casting="same_kind")
    release_pages(laser.ranges)
    return points.reshape(-1, 2), hit.reshape(-1)


def mirror_beams(recording: Recording, number: int) -> Recording:
    """Negate the y coordinate of all points of one laser."""
    points = arrays.copy(recording.points, recording.scratch)
    scans = np.flatnonzero(recording.sensor == number).tolist()
    for t in arrays.release_periodically(scans, lambda: arrays.release_pages(points)):
        points[recording.beams_of(t), 1] *= -1.0
    return replace(recording, points=points)
