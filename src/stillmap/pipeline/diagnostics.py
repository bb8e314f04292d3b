"""Warnings of a run: what limits the trust in its result, where, and what to do about it."""

import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from stillmap.core.array_types import Float
from stillmap.core.errors import advise
from stillmap.core.recording import Recording
from stillmap.pipeline.em_loop import Estimate, IterationRecord
from stillmap.pipeline.final_map import Maps
from stillmap.pipeline.snapshots import extent

_LOST = 0.2  # explained share of a scan's beams below which its pose cannot be trusted


def find_warnings(
    best: Estimate, recording: Recording, records: Sequence[IterationRecord] = ()
) -> list[str]:
    """One sentence per warning, those of the reader first; see `core.errors`.

    Args:
        best: the estimate that was kept.
        recording: the input.
        records: of all iterations.
    """
    return [
        *recording.source.warnings,
        *_input_warnings(best, recording),
        *_source_warnings(records, best.number),
        *_odometry_warnings(best),
        *_length_warnings(best),
        *_place_warnings(best),
        *_fit_warnings(best, recording),
    ]


def find_map_warnings(maps: Maps, recording: Recording, poses: Float) -> list[str]:
    """That the map leaves out what is far from most of the place: one sentence, or none.

    Args:
        maps: of the recording.
        recording: T scans.
        poses: (T, D+1, D+1) T_map_base.
    """
    if not len(maps.beyond):
        return []
    x0, y0, x1, y1 = extent(maps.filtered)
    x, y = recording.T_map_sensor(poses)[:, :2, -1].T
    outside = np.flatnonzero((x < x0) | (x > x1) | (y < y0) | (y > y1))
    what = "surfaces that a few beams show lie"
    if len(outside):
        scan = outside[0]
        named = f"scan {scan} at x {x[scan]:.7g} m, y {y[scan]:.7g} m"
        what = f"{_count_scans(len(outside))} lie{'s' * (len(outside) == 1)}"
        what += f" (first {named})" if len(outside) > 1 else f" ({named})"
    middle = np.array([x0 + x1, y0 + y1]) / 2.0
    distance = float(np.linalg.norm(maps.beyond - middle, axis=1).max())
    return [
        advise(
            f"{what} outside the map, up to {distance:.4g} m from its middle: a map of everything "
            f"would be nearly empty, so it shows {x0:.1f} to {x1:.1f} m in x and {y0:.1f} to "
            f"{y1:.1f} m in y, where most was seen; poses and labels are of all scans",
            "check the poses of these scans" if len(outside) else "limit read.max_range",
        )
    ]


def _input_warnings(best: Estimate, recording: Recording) -> Iterator[str]:
    """Warnings about scans and beams that were left out, and about missing odometry."""
    if skipped := recording.source.n_skipped:
        were = "were" if skipped > 1 else "was"
        why = "left out while reading (`stillmap info` says why)"
        yield f"{_count_scans(skipped)} {were} {why}"
    explained = best.m_step.explained  # NaN: poses were given
    if recording.T_odom_base is None and not (len(explained) and np.isnan(explained).all()):
        yield "no odometry: the robot was assumed to keep its velocity from one scan to the next"


_SOURCES = {
    "odometry": "odometry alone",
    "scans": "scan matching without odometry",
    "odometry_in_stretches": "odometry in stretches that scan matching measured otherwise",
}


def _source_warnings(records: Sequence[IterationRecord], best: int) -> Iterator[str]:
    """That odometry or scans alone explain the recording better than iterations did."""
    for record in records:
        if record.source:
            kept = "were kept" if record.number == best else "were the start of further iterations"
            yield (
                f"poses by {_SOURCES[record.source]} predict scans left out of the map better than "
                f"those of iterations 1 to {record.number - 1}: they {kept}"
            )


def _odometry_warnings(best: Estimate) -> Iterator[str]:
    """Scans that contradict odometry: their poses follow the scans, so nothing has to be done."""
    found = best.m_step.diagnostics
    if faults := found.odometry_faults:
        yield (
            f"odometry and scans disagree at {_count_scans(len(faults))} (wheel slip or stall, "
            f"odometry that starts again), first at {_place(best, faults[0])}: poses follow the "
            "scans there"
        )
    if widened := found.widened:
        yield (
            f"{_count_scans(len(widened))} lay outside the uncertainty of odometry and "
            f"{'were' if len(widened) > 1 else 'was'} found by a wider search, first at "
            f"{_place(best, widened[0])}"
        )


def _length_warnings(best: Estimate) -> Iterator[str]:
    """That scans do not show how far the robot went."""
    bare = best.m_step.diagnostics.bare_stretches
    if bare:
        worst = max(bare, key=lambda stretch: stretch.std)
        others = f" ({len(bare) - 1} more in doubts.length_unknown of run.json)" * (len(bare) > 1)
        yield advise(
            f"from {_place(best, worst.first)} to {_place(best, worst.last)} the scans hardly show "
            f"how far the robot went (bare walls, or few returns): the {worst.metres:.1f} m "
            f"between are uncertain by about {worst.std:.1f} m{others}",
            "measure that length in the map; if it is wrong, record with wheel odometry or a "
            "longer range, or drive back to a place seen before",
        )


def _place_warnings(best: Estimate) -> Iterator[str]:
    """That the robot was carried elsewhere, or may be at another place."""
    found = best.m_step.diagnostics
    for scan in found.ambiguous:
        yield advise(
            f"from {_place(best, scan)} on, another place fits about as well as the one that "
            "odometry leads to: odometry's was kept",
            "look whether walls are doubled there; if so, record again with more of the way "
            "between the two places",
        )
    for scan in found.breaks:
        what = f"before {_place(best, scan)} the robot was carried elsewhere"
        if scan not in found.unconnected:
            yield f"{what}: it was relocalized among the places known from before"
            continue
        yield advise(
            f"{what}: no place after it is known from before, so that this part of the map lies at "
            "an arbitrary pose",
            "record again so that the robot ends where it was before, or map the part before and "
            "the part after on their own",
        )


def _fit_warnings(best: Estimate, recording: Recording) -> Iterator[str]:
    """That scans fit the map badly; not the first of a laser: others may have looked elsewhere."""
    is_lost = best.m_step.explained < _LOST
    starts = [0, *best.m_step.diagnostics.breaks, recording.n_scans]
    for first, end in itertools.pairwise(starts):
        _, of_sensor, n = np.unique(
            recording.sensor[first:end], return_index=True, return_counts=True
        )
        is_lost[first + of_sensor[n > 1]] = False  # of a sensor that moves, each scan is the first
    lost = np.flatnonzero(is_lost)
    if len(lost):
        yield advise(
            f"{_count_scans(len(lost))} fit{'s' * (len(lost) == 1)} the map badly (less than a "
            f"fifth of the beams), first at {_place(best, lost[0])}",
            "look for bent or doubled walls there; if there are any, record that part again, "
            "slower or with odometry",
        )


def _place(best: Estimate, scan: int) -> str:
    """A scan and its position, to be found in the map."""
    x, y = np.round(best.poses[scan, :2, -1], 1) + 0.0  # no negative zero
    return f"scan {scan} (x {x:.1f} m, y {y:.1f} m)"


def _count_scans(n: int) -> str:
    return f"{n:,} scan{'s' * (n != 1)}"
