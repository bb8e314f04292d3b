"""(9) for one scan: the pose that the map so far and the motion prior make most likely.

Single scans of a recording, into a map and out of it again.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.config import option
from stillmap.core.recording import Recording
from stillmap.slam import motion_model
from stillmap.slam.motion_model import MotionPrior

Float = NDArray[np.float64]

Points = NDArray[np.float32]


@dataclass(frozen=True)
class SurfaceOptions:
    """Gaps between end points on one surface, which are filled before scans are laid on them."""

    gap: float = option(1.5, "m between neighbouring end points on a surface, at most")
    straight: float = option(0.1, "m by which three of them may be off a straight line")
    growth: float = option(3.0, "times the gap beside it that a gap may be wide")

    def __post_init__(self) -> None:
        for name in ("gap", "straight", "growth"):
            if not 0.0 <= getattr(self, name) <= 1000.0:
                raise ValueError(f"'slam.surface.{name}' wants 0 to 1000")


def add_scan(
    grid: _core.OccupancyGrid2D,
    recording: Recording,
    e: NDArray[np.float32],
    t: int,
    T_map_base: Float,
    options: SurfaceOptions,
    remove: bool = False,
) -> None:
    """Adds the hits of scan t at a pose (3, 3) to a map to register against, or takes them out.

    What returned nothing may have met glass as well as nothing: it says little against a surface.
    """
    beams = recording.beams_of(t)
    points, hit, weights = recording.points[beams], recording.hit[beams], e[beams]
    T_map_sensor = (T_map_base @ recording.T_base_sensor[recording.sensor[t]])[None]
    all_hit, offset = hit[hit], np.array([0, np.count_nonzero(hit)])
    _core.add_beams(grid, points[hit], all_hit, weights[hit], offset, T_map_sensor, remove=remove)
    _core.interpolate_end_points(
        grid,
        points,
        hit,
        weights,
        np.array([0, len(hit)]),
        T_map_sensor,
        max_gap=options.gap,
        tolerance=options.straight,
        max_gap_ratio=options.growth,
        remove=remove,
    )


@dataclass(frozen=True, eq=False)
class Scan:
    """The hits of a scan, or of several.

    Attributes:
        points: (N, 2) float32, end points in the frame of the robot base.
        weights: (N,) float32, e: how probable it is that each was static.
        T_base_sensor: (3, 3) where the beams begin.
    """

    points: Points
    weights: NDArray[np.float32]
    T_base_sensor: Float


def select_hits(recording: Recording, e: NDArray[np.float32], t: int) -> Scan:
    """The hits of scan t."""
    beams = recording.beams_of(t)
    hit = recording.hit[beams]
    T_base_sensor = recording.T_base_sensor[recording.sensor[t]]
    points = transform_points(recording.points[beams][hit], T_base_sensor)
    return Scan(points, e[beams][hit], T_base_sensor)


def transform_points(points: Points, T: Float) -> Points:
    """Points (N, D) float32 carried over by a transform (D+1, D+1)."""
    return np.ascontiguousarray(points @ T[:-1, :-1].T + T[:-1, -1], dtype=np.float32)


# a wall between a beam and its end: so far before it, and so much of a cell occupied
_MARGIN, _WALL = 0.5, 0.4


@dataclass(frozen=True)
class RegistrationOptions:
    """How one scan is registered; `docs/registration.md` says what is maximised."""

    sigma: float = option(0.04, "m, width of the smoothed field around end points")
    floor: float = option(0.05, "field value of an end point the map cannot explain")
    unknown: float = option(0.2, "what unknown space adds to it: unknown is not free")
    approach: float = option(
        0.5, "m before its end in which a beam says nothing against what it crosses"
    )
    gain: float = option(0.2, "weight of one beam against the motion prior")
    max_iterations: int = option(20, "Newton steps at most")
    window: float = option(3.0, "standard deviations of the prior that are searched")
    search_range: float = option(20.0, "m, beams beyond are left out of the search")
    starts: int = option(3, "best poses of the search that are refined")
    near: float = option(
        0.9, "of the usual share explained: then what lies downhill of odometry is taken"
    )
    doubt_below: float = option(
        0.7, "of the usual share explained, below which a wider search is tried"
    )
    lies: float = option(
        10.0, "nats by which a scan must fit better elsewhere before odometry is disbelieved"
    )
    disagree: float = option(
        3.0, "standard deviations off odometry from where on it says no more where a scan is"
    )
    doubt_translation: float = option(0.5, "m, half width of that search at least")
    doubt_rotation: float = option(0.5, "rad, half width of that search at least")
    carried_below: float = option(
        0.3, "of the usual share explained, below which a robot may have been carried elsewhere"
    )
    through: float = option(
        0.2, "share of a scan's beams that may seem to go through walls, unless it is elsewhere"
    )
    lost_translation: float = option(
        1.5,
        "m, half width of a last search over all headings, where odometry would lead through walls "
        "or there is none",
    )

    def __post_init__(self) -> None:
        for name, low, high in _LIMITS:
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"'slam.registration.{name}' wants {low:g} to {high:g}")


_LIMITS = (
    ("sigma", 0.005, 1.0),
    ("floor", 1e-6, 10.0),
    ("unknown", 0.0, 10.0),
    ("approach", 0.0, 100.0),
    ("gain", 1e-6, 1e3),
    ("max_iterations", 1, 1000),
    ("window", 0.0, 10.0),
    ("search_range", 0.1, 1000.0),
    ("starts", 1, 100),
    ("near", 0.0, 10.0),
    ("doubt_below", 0.0, 1.0),
    ("lies", 0.0, 1e6),
    ("disagree", 0.1, 1e6),
    ("carried_below", 0.0, 1.0),
    ("through", 0.0, 1.0),
    ("doubt_translation", 0.0, 5.0),
    ("doubt_rotation", 0.0, 3.2),
    ("lost_translation", 0.0, 5.0),
)


@dataclass(frozen=True)
class ScanMatch:
    """What came of one scan.

    Attributes:
        T_map_base: (3, 3) the pose.
        covariance: (3, 3) of x, y (map frame) and heading: the inverse curvature of the cost.
        explained: weighted share of the beams that the map explains, in [0, 1].
        misfit: nats, the cost of the beams alone.
        rivals: (R, 4) where the other starts ended up: x, y, heading from the pose, and by how
            many nats they cost more.
        widened: whether a wider search than the prior asked for found the pose.
        astray: whether only a search in all directions did.
        disagrees: whether odometry was disbelieved.
    """

    T_map_base: Float
    covariance: Float
    explained: float
    misfit: float
    rivals: Float
    widened: bool = False
    astray: bool = False
    disagrees: bool = False


def match_scan(
    grid: _core.OccupancyGrid2D,
    scan: Scan,
    prior: MotionPrior,
    other: MotionPrior | None,
    options: RegistrationOptions,
    usual: float,
) -> ScanMatch:
    """The most likely pose of a scan given the map so far and the motion prior, (9).

    Args:
        grid: the map so far.
        scan: what was seen.
        prior: where odometry says the robot is; or, without it, where it ought to be.
        other: what else it may be, should the scan not fit there.
        options: see RegistrationOptions.
        usual: share of a scan that the map explained of late.
    """
    found = _within(grid, scan, prior, options, usual)
    if len(scan.points) == 0:
        return found
    doubtful = options.doubt_below * usual
    windows = [(options.doubt_translation, options.doubt_rotation)]
    if found.explained < doubtful and (
        # odometry that is right takes a robot to places that are new
        not prior.measured or occluded_share(grid, scan, found) > options.through
    ):
        windows.append((options.lost_translation, np.pi))
    for mean in (prior, other):
        if mean is not None and found.explained < doubtful:
            found = _farther(grid, scan, mean, options, found, doubtful, windows)
    if prior.measured and is_inconsistent(prior, found, options):
        # a mean that far off is no mean: it would only draw the pose towards itself
        looser = motion_model.widen_prior(prior, *_off_by(prior, found))
        again = search_pose(grid, scan, looser, options, 0.0, 0.0, start=found.T_map_base)
        if again.misfit <= found.misfit:
            found = dataclasses.replace(again, widened=found.widened, astray=found.astray)
        found = dataclasses.replace(found, disagrees=is_inconsistent(prior, found, options))
    return found


def accept_prior(prior: MotionPrior) -> ScanMatch:
    """The pose where a prior has it, of a scan that has nothing to lie on; its covariance too."""
    covariance = np.diag(1.0 / np.diag(prior.information))
    return ScanMatch(prior.T_map_base, covariance, 1.0, 0.0, np.zeros((0, 4)))


def _within(
    grid: _core.OccupancyGrid2D,
    scan: Scan,
    prior: MotionPrior,
    options: RegistrationOptions,
    usual: float,
) -> ScanMatch:
    """The best pose that the prior allows."""
    if prior.measured:
        near = search_pose(grid, scan, prior, options, 0.0, 0.0, start=prior.T_map_base)
        if near.explained >= options.near * usual:
            return near
    translation = options.window * prior.sigma_translation
    rotation = options.window * prior.sigma_rotation
    return search_pose(grid, scan, prior, options, translation, rotation)


def _farther(
    grid: _core.OccupancyGrid2D,
    scan: Scan,
    prior: MotionPrior,
    options: RegistrationOptions,
    found: ScanMatch,
    doubtful: float,
    windows: list[tuple[float, float]],
) -> ScanMatch:
    """What lies beyond the prior's window, where the scan fits much better there.

    A place that only looks alike would have the robot look through walls.
    """
    for least_translation, least_rotation in windows:
        wide = motion_model.widen_prior(prior, least_translation / 3.0, least_rotation / 3.0)
        window = options.window * wide.sigma_translation, options.window * wide.sigma_rotation
        wider = search_pose(grid, scan, wide, options, *window)
        fits = wider.misfit < found.misfit - options.lies
        if fits and occluded_share(grid, scan, wider) <= options.through:
            found = dataclasses.replace(wider, widened=True, astray=least_rotation == np.pi)
        if found.explained >= doubtful:
            break
    return found


def _off_by(prior: MotionPrior, found: ScanMatch) -> tuple[float, float]:
    d = prior.shift_to(found.T_map_base)
    return float(np.hypot(d[0], d[1])), abs(float(d[2]))


def is_inconsistent(prior: MotionPrior, found: ScanMatch, options: RegistrationOptions) -> bool:
    """Whether a pose is so far off a prior's mean that the prior says no more where it is."""
    metres, radians = _off_by(prior, found)
    off = max(metres / prior.sigma_translation, radians / prior.sigma_rotation)
    return off > options.disagree


def search_pose(
    grid: _core.OccupancyGrid2D,
    scan: Scan,
    prior: MotionPrior,
    options: RegistrationOptions,
    translation: float,
    rotation: float,
    start: Float | None = None,
) -> ScanMatch:
    """The best pose in a window around the prior's mean; no doubts.

    Args:
        grid, scan, prior, options: as `register` has them.
        translation: metres, half width of the window.
        rotation: radians, half width of the window.
        start: (3, 3) where Newton steps begin instead of searching the window.
    """
    T, covariance, cost, explained, _, _, rivals = _core.register_scan(
        grid,
        scan.points,
        scan.weights,
        prior.T_map_base,
        prior.information,
        sigma=options.sigma,
        radius=field_radius(options, grid.resolution),
        floor=options.floor,
        unknown=options.unknown,
        information_scale=options.gain,
        max_iterations=options.max_iterations,
        window_translation=translation,
        window_rotation=min(rotation, float(np.pi)),
        search_range=options.search_range,
        max_candidates=options.starts,
        T_start=start,
    )
    return ScanMatch(T, covariance, explained, cost - prior.penalty(T), rivals)


def occluded_share(grid: _core.OccupancyGrid2D, scan: Scan, found: ScanMatch) -> float:
    """Share of the beams that would have to go through walls that the map knows."""
    return _core.occluded_share(
        grid,
        scan.points,
        scan.weights,
        found.T_map_base,
        scan.T_base_sensor,
        margin=_MARGIN,
        min_occupancy=_WALL,
    )


def field_radius(options: RegistrationOptions, resolution: float) -> int:
    """Cells within which the field is summed up."""
    return max(1, round(2.0 * options.sigma / resolution))
