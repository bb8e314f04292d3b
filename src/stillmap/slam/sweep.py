"""One pass over all scans: each registered against the map that all the others make."""

import numpy as np
from numpy.typing import NDArray

from stillmap import _core, se2
from stillmap.recording.model import Recording
from stillmap.slam import motion, registration
from stillmap.slam.incremental import SlamOptions
from stillmap.slam.motion import MotionPrior
from stillmap.slam.scans import hits, put

Float = NDArray[np.float64]


def sweep(
    recording: Recording,
    e: NDArray[np.float32],
    options: SlamOptions,
    grid: _core.Grid2D,
    poses: Float,
) -> tuple[Float, Float, Float]:
    """Poses (T, 3, 3), covariances (T, 3, 3) and explained shares (T,) after a pass.

    Args:
        recording: 2D.
        e: (M,) probability that each beam was reflected by something static.
        options: see SlamOptions.
        grid: what `poses` and e make; in the end what the new poses make, to the bit.
        poses: (T, 3, 3) T_map_base to begin at; the first one stays.
    """
    poses = poses.copy()
    T = len(poses)
    covariance, explained = np.zeros((T, 3, 3)), np.ones(T)
    increments = _increments(recording, poses)
    for t in range(1, T):
        put(grid, recording, e, t, poses[t], remove=True)
        prior = _between_neighbours(recording, poses, increments, t, options)
        found = registration.search(
            grid,
            *hits(recording, e, t),
            prior,
            options.registration,
            0.0,
            0.0,
            start=poses[t],
        )
        poses[t] = se2.matrix(*se2.parameters(found.T_map_base))
        covariance[t], explained[t] = found.covariance, found.explained
        put(grid, recording, e, t, poses[t])
    return poses, covariance, explained


def _increments(recording: Recording, poses: Float) -> Float:
    odometry = poses if recording.T_odom_base is None else recording.T_odom_base
    return se2.inverse(odometry[:-1]) @ odometry[1:]


def _between_neighbours(
    recording: Recording, poses: Float, increments: Float, t: int, options: SlamOptions
) -> MotionPrior:
    """What the motion from the scan before and to the scan after says of a pose."""
    known = recording.T_odom_base is not None
    one = motion.from_increment(poses[t - 1], increments[t - 1], options.motion, known)
    if t + 1 == len(poses):
        return one
    back = se2.inverse(increments[t])
    return motion.combined(one, motion.from_increment(poses[t + 1], back, options.motion, known))
