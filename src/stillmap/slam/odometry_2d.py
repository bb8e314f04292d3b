"""The M-step of the paper: poses one after the other (9), and the map they make (10)-(15)."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.config import option
from stillmap.core.recording import Recording
from stillmap.slam import motion_model, odometry_faults
from stillmap.slam.lidar_odometry import SpinningOptions
from stillmap.slam.local_map import LocalMap
from stillmap.slam.loop_closure_3d import SpinningLoopOptions
from stillmap.slam.loop_types import LoopClosure, LoopOptions
from stillmap.slam.motion_model import MotionOptions, MotionPrior
from stillmap.slam.pose_graph import PoseGraph
from stillmap.slam.scan_matching import (
    RegistrationOptions,
    Scan,
    ScanMatch,
    SurfaceOptions,
    accept_prior,
    is_inconsistent,
    match_scan,
    occluded_share,
    select_hits,
)

Float = NDArray[np.float64]

_LATELY = 0.1  # weight of one scan in what the map usually explains


@dataclass(frozen=True)
class SlamOptions:
    """The M-step over poses and map."""

    resolution: float = option(0.05, "m, edge of a map cell")
    voxel: float | None = option(
        None, "m, the same of 3D recordings; unset: 0.15, of depth cameras 0.05"
    )
    spacing: float = option(
        0.2, "m, rad or 5 s between scans that later ones are registered against"
    )
    deskew: bool = option(True, "take the motion during a scan out of it, where beams have times")
    motion: MotionOptions = field(default=MotionOptions())
    registration: RegistrationOptions = field(default=RegistrationOptions())
    surface: SurfaceOptions = field(default=SurfaceOptions())
    loops: LoopOptions = field(default=LoopOptions())
    spinning: SpinningOptions = field(default=SpinningOptions())
    spinning_loops: SpinningLoopOptions = field(default=SpinningLoopOptions())

    def __post_init__(self) -> None:
        if not 0.005 <= self.resolution <= 10.0:
            raise ValueError("'slam.resolution' wants 0.005 to 10 metres")
        if self.voxel is not None and not 0.005 <= self.voxel <= 10.0:
            raise ValueError("'slam.voxel' wants 0.005 to 10 metres")
        if not 0.0 <= self.spacing <= 100.0:
            raise ValueError("'slam.spacing' wants 0 to 100 metres")


@dataclass(frozen=True)
class Diagnostics:
    """Where odometry and scans do not agree; numbers of scans, as Mapped has them."""

    widened: list[int] = field(default_factory=list)
    odometry_faults: list[int] = field(default_factory=list)
    breaks: list[int] = field(default_factory=list)
    unconnected: list[int] = field(default_factory=list)


@dataclass(frozen=True)
class MStepResult:
    """What the M-step found.

    Attributes:
        poses: (T, 3, 3) T_map_base; the map frame is the first scan's base.
        covariance: (T, 3, 3) of each pose against the map so far, or with loops closed against
            the map of all others: x, y, heading. That of the guess where there was no map yet.
        grid: the sums alpha, beta of (10) of all scans.
        explained: (T,) share of each scan's beams that the map so far explained; the map of all
            others where poses were swept only.
        widened: indices of the scans that a wider search had to find.
        disagreeing: indices of the scans where odometry was disbelieved.
        breaks: scans before which the robot went astray, or was carried elsewhere.
        apart: those of them from which on no place was seen that is known from before; until loops
            are looked for, those that fit nowhere around.
        loops: attempts at closing loops, accepted or refused.
        graph: the keyframes and what is known of them; None without loop closure.
    """

    poses: Float
    covariance: Float
    grid: _core.OccupancyGrid2D | _core.OccupancyGrid3D
    explained: Float
    widened: list[int]
    odometry_faults: list[int] = field(default_factory=list)
    breaks: list[int] = field(default_factory=list)
    unconnected: list[int] = field(default_factory=list)
    loops: list[LoopClosure] = field(default_factory=list)
    graph: PoseGraph | None = None

    @property
    def diagnostics(self) -> "Diagnostics":
        """Where odometry and scans do not agree."""
        return Diagnostics(self.widened, self.odometry_faults, self.breaks, self.unconnected)

    def without_grid(self) -> "MStepResult":
        """Poses and what is known of them alone: grids are large."""
        return dataclasses.replace(self, grid=type(self.grid)(self.grid.resolution))


def register_scans(
    recording: Recording,
    e: NDArray[np.float32],
    options: SlamOptions,
    progress: Callable[[int, int], None],
    memory: float = np.inf,
) -> MStepResult:
    """Incremental maximum likelihood: register each scan (9), then add it to the map so far (10).

    The grid that comes back is empty: the map so far has no beams without a return, and of scans
    that show the same only one.

    Args:
        recording: 2D.
        e: (M,) probability that each beam was reflected by something static.
        options: see SlamOptions.
        progress: called with the number of scans done and their total.
        memory: metres of travel after which a scan is taken out of the map again.
    """
    T = recording.n_scans
    so_far = _empty(recording, e, options)
    way = _Way.of(T)
    steadiness = motion_model.unknown_steadiness(options.motion)
    steps = motion_model.compute_odometry_steps(recording.T_odom_base)
    seconds = 1e-9 * float(np.median(np.diff(recording.stamp_ns))) if T > 1 else 0.0
    watch = odometry_faults.SlipDetector(
        None if steps is None else steps.increments, options.registration
    )
    travelled = 0.0
    usual = np.zeros(len(recording.T_base_sensor))  # each laser sees its own side
    usual[recording.sensor[0]] = 1.0
    so_far.add(0, way.poses[0], 0.0)
    progress(1, T)
    for t in recording.iter_scans(range(1, T), e):
        last, guess = way.poses[t - 1], way.guess(t, steadiness)
        stalled = watch.stalled(t, last, guess)
        prior, other = _priors(last, steps, t, guess, stalled, options.motion)
        scan, s = select_hits(recording, e, t), recording.sensor[t]
        # without odometry, what a laser sees on its own side at first has nothing to lie on
        has_ground = prior.measured or so_far.has(s)
        if has_ground:
            found = match_scan(so_far.grid, scan, prior, other, options.registration, usual[s])
        else:
            found = accept_prior(prior)
        gone_on = watch.look(t, last, guess, so_far.grid, scan, found)
        if gone_on is not None:
            so_far.forget_since(gone_on.first)  # they are not put back: those to come show the same
            for since, found in enumerate(gone_on.found, gone_on.first):
                way.take(since, found, doubted=True)
            travelled += _metres(way.poses[gone_on.first - 1 : t])
            guess = way.guess(t, steadiness)
        fits_nowhere = _was_carried(so_far, scan, found, usual[s], options.registration)
        leapt = _leapt(so_far, scan, found, (prior, other or guess), options.registration)
        if fits_nowhere or (leapt and steps is not None):
            way.breaks.append(t)
            if fits_nowhere:
                way.nowhere.append(t)
            so_far, usual[:] = _empty(recording, e, options), 0.0
            watch.forget()
        disbelieved = None if prior.measured else other
        is_doubted = disbelieved is not None and is_inconsistent(
            disbelieved, found, options.registration
        )
        way.take(t, found, doubted=is_doubted)
        if has_ground:
            # nothing is usual yet after the first scan
            usual[s] += (_LATELY if usual[s] > 0.0 else 1.0) * (found.explained - usual[s])
            steadiness = steadiness.after(guess.shift_to(found.T_map_base), seconds, options.motion)
        travelled += _metres(way.poses[t - 1 : t + 1])
        so_far.add(t, found.T_map_base, travelled)
        so_far.forget(travelled - memory)
        progress(t + 1, T)
    return way.mapped(_core.OccupancyGrid2D(options.resolution))


@dataclass(frozen=True, eq=False)
class _Way:
    """What was found of each scan so far; Mapped says what it is."""

    poses: Float
    covariance: Float
    explained: Float
    widened: NDArray[np.bool_]
    disagreeing: NDArray[np.bool_]
    breaks: list[int] = field(default_factory=list)
    nowhere: list[int] = field(default_factory=list)

    @classmethod
    def of(cls, T: int) -> "_Way":
        poses = np.tile(np.eye(3), (T, 1, 1))
        none = np.zeros((2, T), np.bool_)
        return cls(poses, np.zeros((T, 3, 3)), np.ones(T), none[0], none[1])

    def take(self, t: int, found: ScanMatch, *, doubted: bool) -> None:
        self.poses[t], self.covariance[t] = found.T_map_base, found.covariance
        self.explained[t], self.widened[t] = found.explained, found.widened
        self.disagreeing[t] |= found.disagrees or doubted

    def guess(self, t: int, steadiness: motion_model.VelocityNoise) -> MotionPrior:
        """The last motion once more; across a break there was none that is known."""
        before = t - 1 if t < 2 or t - 1 in self.breaks[-1:] else t - 2
        return motion_model.constant_velocity_prior(
            self.poses[t - 1], self.poses[before], steadiness
        )

    def mapped(self, grid: _core.OccupancyGrid2D) -> MStepResult:
        return MStepResult(
            self.poses,
            self.covariance,
            grid,
            self.explained,
            np.flatnonzero(self.widened).tolist(),
            np.flatnonzero(self.disagreeing).tolist(),
            self.breaks,
            self.nowhere,
        )


def _metres(poses: Float) -> float:
    return float(np.linalg.norm(np.diff(poses[:, :2, 2], axis=0), axis=1).sum())


def _empty(recording: Recording, e: NDArray[np.float32], options: SlamOptions) -> LocalMap:
    grid = _core.OccupancyGrid2D(options.resolution, options.registration.approach)
    return LocalMap(grid, recording, e, options.spacing, options.surface)


def _was_carried(
    so_far: LocalMap,
    scan: Scan,
    found: ScanMatch,
    usual: float,
    options: RegistrationOptions,
) -> bool:
    """Whether a scan contradicts the map, wherever the robot may have moved by itself.

    A scan of a place that is new is explained as little, but it does not look through walls.
    """
    if found.explained >= options.carried_below * usual or len(scan.points) == 0:
        return False
    return occluded_share(so_far.grid, scan, found) > options.through


def _leapt(
    so_far: LocalMap,
    scan: Scan,
    found: ScanMatch,
    priors: tuple[MotionPrior, MotionPrior],
    options: RegistrationOptions,
) -> bool:
    """Whether a scan fits only where neither odometry nor its motion so far takes the robot.

    It may look alike there. A robot that was not carried would not look through walls without it.
    """
    if found.astray or not found.widened:
        return found.astray
    if not all(is_inconsistent(prior, found, options) for prior in priors):
        return False
    unmoved = dataclasses.replace(found, T_map_base=priors[0].T_map_base)
    return occluded_share(so_far.grid, scan, unmoved) > options.through


def _priors(
    T_map_base: Float,
    steps: motion_model.OdometrySteps | None,
    t: int,
    guess: MotionPrior,
    stalled: bool,
    options: MotionOptions,
) -> tuple[MotionPrior, MotionPrior | None]:
    """Where scan t ought to be after a pose (3, 3), and where else it may be."""
    if steps is None:
        return guess, None
    measured = motion_model.odometry_prior(T_map_base, steps.increments[t - 1], options)
    is_true = steps.plausible[t - 1] and not stalled
    return (measured, guess) if is_true else (guess, measured)
