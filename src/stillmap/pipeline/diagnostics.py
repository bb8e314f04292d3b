"""Warnings of a run: what limits the trust in its result, where, and what to do about it."""

import itertools
from collections.abc import Iterator

import numpy as np

from stillmap.core.array_types import Float
from stillmap.core.errors import advise
from stillmap.core.recording import Recording
from stillmap.pipeline.em_loop import Estimate
from stillmap.pipeline.final_map import Maps
from stillmap.pipeline.snapshots import extent

_LOST = 0.2  # explained share of a scan's beams below which its pose cannot be trusted


def find_warnings(best: Estimate, recording: Recording) -> list[str]:
    """One sentence per warning, those of the reader first; see `core.errors`.

    Args:
        best: the estimate that is kept.
        recording: as mapped.
    """
    return [
        *recording.source.warnings,
        *_input_warnings(best, recording),
        *_length_warnings(best),
        *_scan_warnings(best, recording),
    ]


def find_map_warnings(maps: Maps, recording: Recording, poses: Float) -> list[str]:
    """That the map leaves out what is far from most of the place: one sentence, or none."""
    if not len(maps.beyond):
        return []
    x0, y0, x1, y1 = extent(maps.filtered)
    x, y = recording.T_map_sensor(poses)[:, :2, -1].T
    outside = np.flatnonzero((x < x0) | (x > x1) | (y < y0) | (y > y1))
    what = f"{_count_scans(len(outside))} (first scan {outside[0]})" if len(outside) else "surfaces"
    distance = np.linalg.norm(maps.beyond - np.array([x0 + x1, y0 + y1]) / 2.0, axis=1).max()
    return [
        advise(
            f"{what} outside the map, up to {distance:.4g} m from its middle: it shows "
            f"{x0:.1f} to {x1:.1f} m in x and {y0:.1f} to {y1:.1f} m in y, where most was seen",
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
    if best.m_step.diagnostics.follows_odometry:
        yield advise(
            "poses start from odometry alone: scan matching makes a less likely map",
            "look for walls drawn twice: people who walk along with the robot mislead scans",
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


def _scan_warnings(best: Estimate, recording: Recording) -> Iterator[str]:
    """Warnings about scans of doubtful pose: their number, the first of them, the reason."""
    found = best.m_step.diagnostics
    for scans, what, todo in (
        (
            found.odometry_faults,
            "odometry and scans disagree (wheel slip or stall, odometry that starts again): poses "
            "follow the scans there",
            "",
        ),
        (found.widened, "found by a wider search, outside the uncertainty of odometry", ""),
        (
            found.ambiguous,
            "from there on, the scans contradict the map where odometry leads, or another place "
            "fits about as well; that of odometry was kept",
            "look whether walls are doubled there; if so, record again with more of the way "
            "between the two places, or map the part before and the part after on their own",
        ),
        (
            found.breaks,
            "the robot was carried elsewhere before, and relocalized among the known places",
            "",
        ),
        (
            _lost_scans(best, recording),
            "the scan fits the map badly (less than a fifth of the beams)",
            "look for bent or doubled walls there; if there are any, record that part again, "
            "slower or with odometry",
        ),
    ):
        if scans:
            text = f"{_count_scans(len(scans))}, first {_place(best, scans[0])}: {what}"
            yield advise(text, todo) if todo else text


def _lost_scans(best: Estimate, recording: Recording) -> list[int]:
    """Scans that fit the map badly, but for the first of a laser: others may look elsewhere."""
    is_lost = best.m_step.explained < _LOST
    starts = [0, *best.m_step.diagnostics.breaks, recording.n_scans]
    for first, end in itertools.pairwise(starts):
        sensor = recording.sensor[first:end]
        _, of_sensor, n = np.unique(sensor, return_index=True, return_counts=True)
        is_lost[first + of_sensor[n > 1]] = False  # of a sensor that moves, each scan is the first
    return np.flatnonzero(is_lost).tolist()


def _place(best: Estimate, scan: int) -> str:
    """A scan and its position, to be found in the map."""
    x, y = np.round(best.poses[scan, :2, -1], 1) + 0.0  # no negative zero
    return f"scan {scan} (x {x:.1f} m, y {y:.1f} m)"


def _count_scans(n: int) -> str:
    return f"{n:,} scan{'s' * (n != 1)}"
