"""Motion that no robot makes: odometry that leaps, and given poses that are far from all others."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays, se2, se3
from stillmap.core.advice import advise
from stillmap.core.recording import Recording
from stillmap.core.square_box import find_busiest
from stillmap.prepare.options import MAX_POINT_DISTANCE

Float = NDArray[np.float64]

# m and m/s: beyond both, a step of odometry is none; airliners do 250 m/s, and odometry that starts
# again within the same building is told from the scans
_MIN_LEAP, _MAX_SPEED = 100.0, 300.0
# cells from the middle, by dimension: a quarter of those that kernels number
_REACH = {2: 1 << 22, 3: 1 << 21}


def remove_leaps(recording: Recording) -> tuple[Recording, list[str]]:
    """The recording with odometry that goes on as before where it leapt, and a sentence about it.

    Without leaps the recording itself.
    """
    T = recording.T_odom_base
    if T is None or len(T) < 2:
        return recording, []
    steps = np.linalg.norm(np.diff(T[:, :-1, -1], axis=0), axis=1)
    seconds = 1e-9 * np.diff(recording.stamp_ns)
    leaps = np.flatnonzero(steps > np.maximum(_MIN_LEAP, _MAX_SPEED * seconds))
    if not len(leaps):
        return recording, []
    corrected = T.copy()
    for last, end in zip(leaps, [*leaps[1:].tolist(), len(T) - 1], strict=True):
        part, start = slice(last + 1, end + 1), corrected[last]
        step = se2.inverse(corrected[last - 1]) @ start if last else np.eye(len(start))
        corrected[part] = start @ step @ se2.inverse(T[last + 1]) @ T[part]
    corrected = (se2 if recording.dimension == 2 else se3).normalize(corrected)
    first = leaps[0]
    sentence = (
        f"odometry leaps at {len(leaps)} scan{'s' * (len(leaps) > 1)}, first before scan "
        f"{first + 1} by {steps[first]:.4g} m in {seconds[first]:.3g} s: the scans alone say how "
        "the robot moved there"
    )
    return replace(recording, T_odom_base=corrected), [sentence]


def leave_out_far_scans(
    recording: Recording, poses: Float, resolution: float
) -> tuple[Recording, list[str]]:
    """The recording without the beams of scans too far from most others, and a sentence about it.

    Where no scan is, the recording itself.

    Args:
        recording: T scans.
        poses: (T, D+1, D+1) T_map_base that were given, in a frame that begins at one of them.
        resolution: m, edge of a cell.
    """
    xy = poses[:, :2, -1]
    numbered = _REACH[recording.dimension] * resolution
    reach = min(MAX_POINT_DISTANCE, numbered)
    middle = find_busiest(np.floor(xy).astype(np.int64), int(reach))
    if np.abs(middle).max() > numbered:  # of two places the one where the frame begins
        middle = np.zeros(2, np.int64)
    distance = np.linalg.norm(poses[:, :-1, -1] - [*middle, 0.0][: recording.dimension], axis=1)
    far = np.flatnonzero(distance > reach)
    if not len(far):
        return recording, []
    points = arrays.copy(recording.points, recording.scratch)
    hit = arrays.copy(recording.hit, recording.scratch)
    for t in far.tolist():
        beams = recording.beams_of(t)
        points[beams], hit[beams] = np.nan, False
    one, places = far[0], poses[far[0], :2, -1]
    sentence = advise(
        f"{len(far)} scan{'s are' if len(far) > 1 else ' is'} farther than {reach / 1e3:g} km from "
        f"most others by the given poses, first scan {one} at ({places[0]:.7g}, {places[1]:.7g}) "
        "m: the beams are not used",
        "correct these poses",
    )
    return replace(recording, points=points, hit=hit), [sentence]
