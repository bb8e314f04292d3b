"""What somebody should know before he trusts a result."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap import em, slam
from stillmap.core.json import skipped_count
from stillmap.core.recording import Recording
from stillmap.pipeline.options import Options
from stillmap.results.protocols import IterationRecordLike


def cautions(
    records: Sequence[IterationRecordLike],
    kept: int,
    explained: NDArray[np.float64],
    doubts: slam.Doubts,
    recording: Recording,
    options: Options,
) -> list[str]:
    """A sentence each, those of the reader first.

    Args:
        records: the numbers of every iteration.
        kept: the iteration that was kept; (T,) `explained` and `doubts` are of it.
        explained: share of each scan's beams that the map so far explained; NaN: poses were given.
        doubts: where odometry and scans do not agree.
        recording: what all of it is about.
        options: as resolved.
    """
    out = _of_reading(recording.source)
    noise = options.em.tolerance * recording.n_beams
    dips = [
        after.number
        for before, after in itertools.pairwise(records)
        if after.bound < before.bound - noise
    ]
    if dips and not em.fixed_iterations(options.estimator):
        out.append(
            f"the likelihood dipped at iteration {', '.join(map(str, dips))}: poses are estimated "
            f"by matching, not by it; iteration {kept} is the best and was kept"
        )
    given = len(explained) > 0 and bool(np.isnan(explained).all())
    if recording.T_odom_base is None and not given:
        out.append("no odometry: a constant velocity was assumed between scans")
    out += _of_poses(doubts)
    lost = np.flatnonzero(explained < 0.2)
    if len(lost):
        out.append(
            f"{len(lost)} scans fit the map badly (less than a fifth of their beams), the first "
            f"is scan {lost[0]}: the map may be bent there"
        )
    return out


def _of_reading(source: Mapping[str, Any]) -> list[str]:
    """What the reader noted; of strange folders anything may stand there."""
    noted = source.get("warnings")
    out = [text for text in noted if isinstance(text, str)] if isinstance(noted, list) else []
    skipped = skipped_count(source)
    if skipped:
        out.append(f"scans left out while reading: {skipped} (`stillmap info` says why)")
    return out


def _of_poses(doubts: slam.Doubts) -> list[str]:
    out = []
    if doubts.disagreeing:
        n = len(doubts.disagreeing)
        out.append(
            f"odometry and scans disagree at {n} scan{'s' * (n > 1)} (wheels that slip or "
            f"stall, odometry that begins again), first at scan {doubts.disagreeing[0]}: poses "
            "follow the scans there"
        )
    if doubts.widened:
        out.append(
            f"{len(doubts.widened)} scans lay outside what odometry allows and were found by a "
            f"wider search, the first is scan {doubts.widened[0]}"
        )
    for scan in doubts.breaks:
        out.append(
            f"before scan {scan} the robot lost its way or was carried elsewhere: "
            + (
                "nothing seen after it is known from before, so it stands beside the rest"
                if scan in doubts.apart
                else "where it went on was found among the places known from before"
            )
        )
    return out
