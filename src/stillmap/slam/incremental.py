"""The M-step of the paper: poses one after the other (9), and the map they make (10)-(15)."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from stillmap import _core, se2
from stillmap.options import field_with_doc
from stillmap.recording.model import Recording
from stillmap.slam import motion
from stillmap.slam.loops import Closure, LoopOptions
from stillmap.slam.motion import MotionOptions
from stillmap.slam.registration import RegistrationOptions, register
from stillmap.slam.scans import hits, put

Float = NDArray[np.float64]


@dataclass(frozen=True)
class SlamOptions:
    """The M-step over poses and map."""

    resolution: float = field_with_doc(0.05, "m, edge of a map cell")
    motion: MotionOptions = field(default=MotionOptions())
    registration: RegistrationOptions = field(default=RegistrationOptions())
    loops: LoopOptions = field(default=LoopOptions())

    def __post_init__(self) -> None:
        if not 0.005 <= self.resolution <= 10.0:
            raise ValueError("'slam.resolution' wants 0.005 to 10 metres")


@dataclass(frozen=True)
class Mapped:
    """What the M-step found.

    Attributes:
        poses: (T, 3, 3) T_map_base; the map frame is the first scan's base.
        covariance: (T, 3, 3) of each pose against the map so far, or with loops closed against
            the map of all others: x, y, heading.
        grid: the sums alpha, beta of (10) of all scans.
        explained: (T,) share of each scan's beams that the map so far explained; the map of all
            others where poses were swept only.
        widened: indices of the scans that a wider search had to find.
        loops: attempts at closing loops, accepted or refused.
    """

    poses: Float
    covariance: Float
    grid: _core.Grid2D
    explained: Float
    widened: list[int]
    loops: list[Closure] = field(default_factory=list)

    def without_grid(self) -> "Mapped":
        """Poses and what is known of them alone: grids are large."""
        return dataclasses.replace(self, grid=_core.Grid2D(self.grid.resolution))


def build(
    recording: Recording,
    e: NDArray[np.float32],
    options: SlamOptions,
    progress: Callable[[int, int], None],
    memory: float = np.inf,
) -> Mapped:
    """Incremental maximum likelihood: register each scan (9), then add it to the map (10).

    Args:
        recording: 2D.
        e: (M,) probability that each beam was reflected by something static.
        options: see SlamOptions.
        progress: called with the number of scans done and their total.
        memory: metres of travel after which a scan is taken out of the map again.
    """
    T = recording.n_scans
    grid = _core.Grid2D(options.resolution, options.registration.approach)
    poses = np.tile(np.eye(3), (T, 1, 1))
    covariance = np.zeros((T, 3, 3))
    explained = np.ones(T)
    widened = []
    travelled = np.zeros(T)
    oldest = 0
    for t in range(T):
        if t > 0:
            prior = _motion_prior(recording, poses, t, options.motion)
            found = register(grid, *hits(recording, e, t), prior, options.registration)
            poses[t], covariance[t] = found.T_map_base, found.covariance
            explained[t] = found.explained
            if found.widened:
                widened.append(t)
        put(grid, recording, e, t, poses[t])
        if t > 0:
            travelled[t] = travelled[t - 1] + np.linalg.norm(poses[t, :2, 2] - poses[t - 1, :2, 2])
        while travelled[oldest] < travelled[t] - memory:
            put(grid, recording, e, oldest, poses[oldest], remove=True)
            oldest += 1
        progress(t + 1, T)
    return Mapped(poses, covariance, grid, explained, widened)


def _motion_prior(
    recording: Recording, poses: Float, t: int, options: MotionOptions
) -> motion.MotionPrior:
    odometry = recording.T_odom_base
    if odometry is None:
        return motion.from_constant_velocity(poses[t - 1], poses[max(t - 2, 0)], options)
    increment = se2.inverse(odometry[t - 1]) @ odometry[t]
    return motion.from_odometry(poses[t - 1], increment, options)
