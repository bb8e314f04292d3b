"""From readings to beams: end points and hits, a piece of the recording at a time."""

import dataclasses
import itertools
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.recording import ranges
from stillmap.recording.options import BEYOND, ReadOptions
from stillmap.recording.ros.lasers import Scans, Shape
from stillmap.recording.spool import empty, let_go

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


def understood(scans: Scans, options: ReadOptions) -> tuple[ranges.RangeRule, list[str]]:
    """How a laser's readings are understood, and warnings in words."""
    sample = _sample(scans)
    usual = scans.usual
    warnings = []
    nearest = usual.range_min if 0.0 < usual.range_min < BEYOND else 0.0
    finite = sample[(sample >= ranges.ZERO_BELOW) & (sample < BEYOND)]
    if finite.size and np.mean(finite < nearest) > _MOST:
        warnings.append(f"range_min {nearest:g} m is beyond most readings: not heeded")
        nearest = 0.0
    nearest = max(nearest, options.min_range)
    declared = usual.range_max if 0.0 < usual.range_max < BEYOND else None
    if declared is not None and declared <= nearest:
        declared = None
    rule, more = ranges.decide(sample, declared, options)
    return dataclasses.replace(rule, min_range=nearest), warnings + more


def _sample(scans: Scans) -> NDArray[np.float32]:
    """(K, n) readings of scans evenly spread over the recording; short ones end in NaN."""
    lengths = scans.lengths
    step = max(1, -(-int(lengths.sum()) // _SAMPLE))
    chosen = np.arange(0, scans.n_scans, step)
    out = np.full((len(chosen), int(lengths[chosen].max(initial=1))), np.nan, np.float32)
    for row, t in zip(out, chosen, strict=True):
        row[: lengths[t]] = scans.ranges[scans.start[t] : scans.start[t] + lengths[t]]
    let_go(scans.ranges)
    return out


def all_beams(
    lasers: list[Scans],
    rules: list[ranges.RangeRule],
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
    points = empty((int(offset[-1]), 2), np.float32, scratch)
    hit = empty((int(offset[-1]),), np.bool_, scratch)
    steps = [_steps(scans) for scans in lasers]
    times = empty(hit.shape, np.float32, scratch) if any(np.any(s) for s in steps) else None
    place = np.empty(len(scan), np.int64)  # where the beams of each scan go
    place[scan] = offset[:-1]
    first = 0
    for scans, rule, mirror, step in zip(lasers, rules, mirrored, steps, strict=True):
        its = place[first : first + scans.n_scans]
        _fill(scans, rule, mirror, its, points, hit)
        if times is not None:
            _fill_times(scans, step, its, times)
        first += scans.n_scans
    return Beams(scan, offset, points, hit, times)


def _runs(scans: Scans) -> list[tuple[int, int]]:
    """Scans that follow one another, in pieces: first and end of each, all of one shape."""
    lengths = scans.lengths
    follows = (scans.start[1:] == scans.start[:-1] + lengths[:-1]) & (
        scans.shape[1:] == scans.shape[:-1]
    )
    edges = [0, *(np.flatnonzero(~follows) + 1).tolist(), scans.n_scans]
    runs = []
    for begin, end in itertools.pairwise(edges):
        at_once = max(1, _PIECE // max(int(lengths[begin]), 1))
        runs += [(at, min(at + at_once, end)) for at in range(begin, end, at_once)]
    return runs


def _fill(
    scans: Scans,
    rule: ranges.RangeRule,
    mirror: bool,
    place: NDArray[np.int64],
    points: NDArray[np.float32],
    hit: NDArray[np.bool_],
) -> None:
    directions: dict[int, NDArray[np.float32]] = {}
    for begin, end in _runs(scans):
        shape = int(scans.shape[begin])
        n = scans.shapes[shape].n
        if shape not in directions:
            directions = {shape: _directions(scans.shapes[shape], mirror)}
        at = int(scans.start[begin])
        readings = scans.ranges[at : at + (end - begin) * n].reshape(-1, n)
        length, hits = ranges.apply(readings, rule)
        ends = length[:, :, None] * directions[shape]
        if np.all(np.diff(place[begin:end]) == n):
            to = slice(int(place[begin]), int(place[begin]) + hits.size)
            points[to], hit[to] = ends.reshape(-1, 2), hits.reshape(-1)
        else:
            for k, to_first in enumerate(place[begin:end].tolist()):
                points[to_first : to_first + n], hit[to_first : to_first + n] = ends[k], hits[k]
        let_go(scans.ranges)
        let_go(points)
        let_go(hit)


def _directions(shape: Shape, mirror: bool) -> NDArray[np.float32]:
    """(n, 2) unit vectors of the beams."""
    angle = -shape.angles() if mirror else shape.angles()
    return np.stack([np.cos(angle), np.sin(angle)], axis=1).astype(np.float32)


def _steps(scans: Scans) -> NDArray[np.float64]:
    """Seconds between two beams, for each shape; 0 where none are told or none can be meant."""
    period = 1.0 / scans.rate_hz if scans.rate_hz else _LONGEST
    steps = np.array([s.time_increment for s in scans.shapes])
    takes = np.abs(steps) * np.array([max(s.n - 1, 1) for s in scans.shapes])
    # drivers that leave the field unset or fill it wrongly are many
    fine = np.isfinite(steps) & (takes <= min(_LONGEST, 1.5 * period))
    return np.where(fine, steps, 0.0)


def _fill_times(
    scans: Scans,
    steps: NDArray[np.float64],
    place: NDArray[np.int64],
    times: NDArray[np.float32],
) -> None:
    rows = [
        (s * np.arange(h.n)).astype(np.float32) for s, h in zip(steps, scans.shapes, strict=True)
    ]
    for t, first in enumerate(place.tolist()):
        row = rows[scans.shape[t]]
        times[first : first + len(row)] = row
        if t % 4096 == 0:
            let_go(times)
    let_go(times)
