"""One pass over all scans: each registered against the map that all the others make."""

import numpy as np
from numpy.typing import NDArray

from stillmap import se2
from stillmap.recording.model import Recording
from stillmap.slam import motion, registration
from stillmap.slam.incremental import Mapped, SlamOptions
from stillmap.slam.motion import MotionPrior
from stillmap.slam.scans import hits, put

Float = NDArray[np.float64]


def sweep(
    recording: Recording, e: NDArray[np.float32], options: SlamOptions, mapped: Mapped
) -> Mapped:
    """Poses, covariances and explained shares after a pass; the first pose stays.

    The grid is changed in place. In the end it is what the new poses and e make, to the bit.

    Args:
        recording: 2D.
        e: (M,) probability that each beam was reflected by something static.
        options: see SlamOptions.
        mapped: where to begin; its grid is what its poses and e make.
    """
    grid, poses = mapped.grid, mapped.poses.copy()
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
    return Mapped(poses, covariance, grid, explained, mapped.widened, mapped.loops)


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
