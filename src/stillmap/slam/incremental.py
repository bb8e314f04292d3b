"""The M-step of the paper: poses one after the other (9), and the map they make (10)-(15)."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from stillmap import _core, se2
from stillmap.options import field_with_doc
from stillmap.recording.model import Recording
from stillmap.slam import motion
from stillmap.slam.motion import MotionOptions
from stillmap.slam.registration import RegistrationOptions, register

Float = NDArray[np.float64]


@dataclass(frozen=True)
class SlamOptions:
    """The M-step over poses and map."""

    resolution: float = field_with_doc(0.05, "m, edge of a map cell")
    motion: MotionOptions = field(default=MotionOptions())
    registration: RegistrationOptions = field(default=RegistrationOptions())

    def __post_init__(self) -> None:
        if not 0.005 <= self.resolution <= 10.0:
            raise ValueError("'slam.resolution' wants 0.005 to 10 metres")


@dataclass(frozen=True)
class Mapped:
    """What the M-step found.

    Attributes:
        poses: (T, 3, 3) T_map_base; the map frame is the first scan's base.
        covariance: (T, 3, 3) of each pose against the map so far: x, y, heading.
        grid: the sums alpha, beta of (10) of all scans.
        explained: (T,) share of each scan's beams that the map so far explained.
        widened: indices of the scans that a wider search had to find.
    """

    poses: Float
    covariance: Float
    grid: _core.Grid2D
    explained: Float
    widened: list[int]


def build(
    recording: Recording,
    e: NDArray[np.float32],
    options: SlamOptions,
    progress: Callable[[int, int], None],
) -> Mapped:
    """Incremental maximum likelihood: register each scan (9), then add it to the map (10).

    Args:
        recording: 2D.
        e: (M,) probability that each beam was reflected by something static.
        options: see SlamOptions.
        progress: called with the number of scans done and their total.
    """
    T = recording.n_scans
    grid = _core.Grid2D(options.resolution)
    poses = np.tile(np.eye(3), (T, 1, 1))
    covariance = np.zeros((T, 3, 3))
    explained = np.ones(T)
    widened = []
    for t in range(T):
        beams = recording.beams_of(t)
        points, hit, e_t = recording.points[beams], recording.hit[beams], e[beams]
        T_base_sensor = recording.T_base_sensor[recording.sensor[t]]
        if t > 0:
            prior = _motion_prior(recording, poses, t, options.motion)
            in_base = in_frame(points[hit], T_base_sensor)
            found = register(grid, in_base, e_t[hit], prior, options.registration)
            poses[t], covariance[t] = found.T_map_base, found.covariance
            explained[t] = found.explained
            if found.widened:
                widened.append(t)
        T_map_sensor = poses[t] @ T_base_sensor
        _core.add_beams(grid, points, hit, e_t, np.array([0, len(hit)]), T_map_sensor[None])
        progress(t + 1, T)
    return Mapped(poses, covariance, grid, explained, widened)


def in_frame(points: NDArray[np.float32], T: Float) -> NDArray[np.float32]:
    """Points (N, D) float32 carried over by a transform (D+1, D+1)."""
    return np.ascontiguousarray(points @ T[:-1, :-1].T + T[:-1, -1], dtype=np.float32)


def _motion_prior(
    recording: Recording, poses: Float, t: int, options: MotionOptions
) -> motion.MotionPrior:
    odometry = recording.T_odom_base
    if odometry is None:
        return motion.from_constant_velocity(poses[t - 1], poses[max(t - 2, 0)], options)
    increment = se2.inverse(odometry[t - 1]) @ odometry[t]
    return motion.from_odometry(poses[t - 1], increment, options)
