"""Some scans of a recording, as a small recording of their own."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.recording import Recording

Float = NDArray[np.float64]
Values = NDArray[Any]
Index = NDArray[np.intp]

# of a planar scan that are registered, more than lasers have: all around, they end as far apart as
# cells of 0.05 m at 16 m
_MAX_BEAMS = 2048
# of an all-round view: sectors, the share of them that is seen, and scans that are looked at
_SECTORS, _MIN_SECTORS, _SAMPLED = 36, 0.8, 9


def beams_of_scans(recording: Recording, scans: Index, max_beams: int) -> list[Index]:
    """Beams of each of some scans, rising: of more than max_beams every so many."""
    spans = [recording.beams_of(t) for t in scans.tolist()]
    return [
        np.arange(of.start, of.stop, max(1, -(-(of.stop - of.start) // max_beams))) for of in spans
    ]


def select_beams(
    recording: Recording, scans: Index, beams: list[Index], T_odom_base: Float | None
) -> Recording:
    """These beams of these scans, without beam times, pictures and recorded poses.

    Args:
        recording: 2D or 3D.
        scans: (n,) rising.
        beams: of each of these scans.
        T_odom_base: (n, D+1, D+1) odometry of the result.
    """
    return replace(
        recording,
        stamp_ns=recording.stamp_ns[scans],
        offset=np.concatenate([[0], np.cumsum([len(of) for of in beams], dtype=np.int64)]),
        points=np.concatenate([recording.points[of] for of in beams]),
        hit=np.concatenate([recording.hit[of] for of in beams]),
        sensor=recording.sensor[scans],
        T_odom_base=T_odom_base,
        T_recorded_base=None,
        beam_time=None,
        images=None,
        record=None,
    )


def thin_scans(recording: Recording, values: Values) -> tuple[Recording, Values]:
    """A planar recording with fewer beams in the scans that have more than registration needs.

    Normals take time in proportion to the square of the beams on a surface; the search of a scan
    that resembles no place, for all poses times all beams.

    Args:
        recording: 2D, M beams.
        values: (M,) of every beam.

    Returns:
        The recording and the values of its beams, themselves where no scan has too many.
    """
    if int(np.diff(recording.offset).max(initial=0)) <= _MAX_BEAMS:
        return recording, values
    beams = beams_of_scans(recording, np.arange(recording.n_scans), _MAX_BEAMS)
    kept = np.concatenate(beams)
    thinned = replace(
        select_beams(recording, np.arange(recording.n_scans), beams, recording.T_odom_base),
        beam_time=None if recording.beam_time is None else recording.beam_time[kept],
    )
    return thinned, values[kept]


def sees_all_round(recording: Recording) -> bool:
    """True if scans cover nearly all azimuths of the sensor."""
    scans = np.unique(np.linspace(0, recording.n_scans - 1, _SAMPLED).astype(np.int64))
    beams = [recording.beams_of(t) for t in scans.tolist()]
    points = np.concatenate([recording.points[of].compress(recording.hit[of], 0) for of in beams])
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    sector = np.floor((azimuth[np.isfinite(azimuth)] / math.tau + 0.5) * _SECTORS)
    return len(np.unique(sector % _SECTORS)) >= _MIN_SECTORS * _SECTORS
