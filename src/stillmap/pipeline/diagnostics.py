"""Warnings of a run: what limits the trust in its result."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from stillmap import slam
from stillmap.core.json import count_skipped
from stillmap.core.recording import Recording
from stillmap.pipeline.estimate import Estimate, IterationRecord


def find_warnings(
    best: Estimate, recording: Recording, records: Sequence[IterationRecord] = ()
) -> list[str]:
    """One sentence per warning, those of the reader first.

    Args:
        best: the estimate that was kept.
        recording: the input.
        records: of all iterations.
    """
    explained = best.m_step.explained  # NaN: poses were given
    out = _reader_warnings(recording.source)
    given = len(explained) > 0 and bool(np.isnan(explained).all())
    if recording.T_odom_base is None and not given:
        out.append("no odometry: a constant velocity was assumed between scans")
    out += _source_warnings(records, best.number)
    out += _pose_warnings(best.m_step.diagnostics)
    lost = np.flatnonzero(explained < 0.2)
    if len(lost):
        out.append(
            f"{len(lost)} scans fit the map badly (less than a fifth of their beams), the first "
            f"is scan {lost[0]}: the map may be bent there"
        )
    return out


def _reader_warnings(source: Mapping[str, Any]) -> list[str]:
    """The reader's warnings; a foreign recording folder may hold anything there."""
    noted = source.get("warnings")
    out = [text for text in noted if isinstance(text, str)] if isinstance(noted, list) else []
    skipped = count_skipped(source)
    if skipped:
        out.append(f"scans left out while reading: {skipped} (`stillmap info` says why)")
    return out


def _source_warnings(records: Sequence[IterationRecord], best: int) -> list[str]:
    """That odometry alone, or scans alone, explain the recording better than iterations did."""
    out = []
    for record in records:
        if record.source:
            kept = "its poses were kept" if record.number == best else "EM went on from its poses"
            name = {"odometry": "odometry alone", "scans": "scan matching without odometry"}
            out.append(
                f"{name[record.source]} predicts held-out scans better than iterations 1 to "
                f"{record.number - 1} did: {kept}"
            )
    return out


def _pose_warnings(diagnostics: slam.Diagnostics) -> list[str]:
    out, faults, widened = [], diagnostics.odometry_faults, diagnostics.widened
    if faults:
        out.append(
            f"odometry and scans disagree at {len(faults)} scan{'s' * (len(faults) > 1)} (wheel "
            f"slip or stall, odometry that starts again), first at scan {faults[0]}: poses follow "
            "the scans there"
        )
    if widened:
        out.append(
            f"{len(widened)} scans lay outside the odometry's uncertainty and were found by a "
            f"wider search, the first is scan {widened[0]}"
        )
    if bare := diagnostics.bare_stretches:
        worst = max(bare, key=lambda stretch: stretch.std)
        others = f"; {len(bare) - 1} more in doubts.length_unknown of run.json" * (len(bare) > 1)
        out.append(
            f"from scan {worst.first} to scan {worst.last} the scans hardly show how far the robot "
            f"went (bare walls, or few returns): the length of that way, {worst.metres:.1f} m, has "
            f"a standard deviation of about {worst.std:.1f} m{others}"
        )
    for scan in diagnostics.ambiguous:
        out.append(
            f"from scan {scan} on, another place fits about as well as the one that odometry leads "
            "to: odometry's was kept"
        )
    for scan in diagnostics.breaks:
        out.append(
            f"before scan {scan} the robot was carried elsewhere: "
            + (
                "no place seen after it is known from before, so it is not connected to the rest"
                if scan in diagnostics.unconnected
                else "it was relocalized among the places known from before"
            )
        )
    return out
