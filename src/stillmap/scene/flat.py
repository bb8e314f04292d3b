"""Parts of a recording in space as a recording in the plane."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stillmap.recording.model import Recording


def flat_recording(
    recording: Recording,
    points: NDArray[np.float32],
    hit: NDArray[np.bool_],
    offset: NDArray[np.int64],
) -> Recording:
    """The same scans with other beams, of one sensor in the middle of the robot.

    Args:
        recording: 3D, T scans.
        points, hit, offset: (N, 2), (N,), (T + 1,); see Recording.
    """
    return replace(
        recording,
        points=points,
        hit=hit,
        offset=offset,
        T_base_sensor=np.eye(3)[None],
        sensor=np.zeros(recording.n_scans, np.int32),
        T_odom_base=None,
        T_recorded_base=None,
        beam_time=None,
        images=None,
    )
