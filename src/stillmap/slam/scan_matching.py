"""Scan matching in 2D, (9): the pose of one scan given the map so far and the motion prior.

Likelihood field around end points, correlative search, Newton refinement; what is maximized is in
`docs/poses.md`.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

import stillmap._core as _core
from stillmap.core.array_types import Float
from stillmap.slam import motion_model, scan_hits
from stillmap.slam.motion_model import MotionPrior
from stillmap.slam.scan_hits import NORMALS, Scan

# likelihood field: m, std around end points; value of an unexplained end point; value added in
# unknown space, which is not free; weight of an end point with evidence of its own
_FIELD_STD, _FLOOR, _UNKNOWN, INFORMATION_SCALE = 0.04, 0.05, 0.2, 0.4
_MAX_ITERATIONS = 20  # Newton
_MAX_SEARCH_RANGE = 20.0  # m; longer beams are left out of the correlative search
_MAX_CANDIDATES = 3  # poses of the correlative search that are refined
_MAX_WINDOW = 100.0  # m, half width of a search window, whatever odometry claims
_SEARCH_STDS = 3.0  # half width of the search window in standard deviations of the prior
# of the usual explained share: enough for the optimum next to odometry; too little without a wider
# search
LOCAL_SHARE, _WIDEN_BELOW = 0.9, 0.7
# m, rad: half widths of the wider searches, at least
_WIDE_WINDOWS = (0.5, 0.5), (1.5, math.pi)
MIN_GAIN = 7.0  # nats that a pose must gain outside the learned noise of odometry
FAULT_COST = -math.log(1e-6)  # nats: odometry fails at a scan, about once a day of driving
# nats that new parts of the world cost at most where odometry leads: a robot that moves on sees
# them, and buildings repeat, so that a place that is known and alike proves little
_MAX_UNKNOWN_COST = 14.0
_OCCLUDED_COST = 1.5  # of a beam that passes through a wall, as its end point may not show
_INCONSISTENT_STDS = 3.0  # standard deviations from a prior's mean: it no longer holds
MAX_OCCLUDED = 0.2  # share of a scan's beams that may seem to pass through walls
# a wall: occupancy, m before the end of the beam; and of a beam that ends behind it
WALL_OCCUPANCY, _WALL_MARGIN, _NEAR_WALL = 0.4, 0.5, 0.1


@dataclass(frozen=True)
class ScanMatch:
    """Result of matching one scan.

    Attributes:
        T_map_base: (3, 3).
        covariance: (3, 3) of x, y (map frame) and heading: inverse curvature of the cost.
        explained: weighted share of the beams that the map explains, in [0, 1].
        compute_cost: of `cost`, as long as the map does not change.
        alternatives: (R, 4) optima of the other candidates: x, y, heading from the pose, and their
            additional cost in nats.
        widened: found only by a wider search than the prior's window.
        contradicts_odometry: odometry was rejected.
        may_be_fault: as likely if odometry failed, but for its rarity.
    """

    T_map_base: Float
    covariance: Float
    explained: float
    compute_cost: Callable[[], float]
    alternatives: Float
    widened: bool = False
    contradicts_odometry: bool = False
    may_be_fault: bool = False

    @cached_property
    def cost(self) -> float:
        """Nats, of the beams without the prior, those through walls included; with a prior of
        odometry, of end points in unknown space no more than `_MAX_UNKNOWN_COST`."""
        return self.compute_cost()


def match_scan(
    grid: _core.OccupancyGrid2D,
    scan: Scan,
    prior: MotionPrior,
    usual: float,
    learned: MotionPrior | None = None,
) -> ScanMatch:
    """The most likely pose of a scan given the map so far and the motion prior, (9).

    Args:
        grid: the map so far.
        scan: its hits.
        prior: from odometry, else from the constant-velocity model.
        usual: recent average of the explained share.
        learned: the same with the odometry noise learned so far. A pose outside it must fit better
            by as much as it is less likely.
    """
    if not prior.is_odometry:  # all that is known: its mean may lie beside another optimum
        return search_within_prior(grid, scan, prior)
    match = _match_within_prior(grid, scan, learned or prior, usual)
    is_wider = learned is not None and (prior.information != learned.information).any()
    if is_wider and len(scan.points) and is_poor(match, usual):
        wider = _match_within_prior(grid, scan, prior, usual)
        match = wider if wider.cost < match.cost - MIN_GAIN else match
    return _loosen_prior(grid, scan, prior, match)


def is_poor(match: ScanMatch, usual: float) -> bool:
    """True if a map explains much less of a scan than usual."""
    return match.explained < _WIDEN_BELOW * usual


def compare_priors(
    grid: _core.OccupancyGrid2D,
    scan: Scan,
    prior: MotionPrior,
    learned: MotionPrior | None,
    alternative: MotionPrior,
    match: ScanMatch,
    usual: float,
) -> ScanMatch:
    """The match within the prior of odometry, or outside it if that odometry fails is likelier.

    Args:
        grid: the map so far.
        scan: its hits, at least one.
        prior: of odometry.
        learned: as of `match_scan`.
        alternative: at constant velocity.
        match: within the prior of odometry.
        usual: recent average of the explained share.
    """
    if not is_inconsistent(prior, alternative.T_map_base):
        return match
    failed = _match_within_prior(grid, scan, alternative, usual)
    if not is_inconsistent(prior, failed.T_map_base):
        return match
    cost = match.cost + motion_cost(learned or prior, match)
    gain = cost - failed.cost - motion_cost(alternative, failed)
    if gain > FAULT_COST and not is_poor(failed, usual):
        return dataclasses.replace(failed, widened=True, contradicts_odometry=True)
    return dataclasses.replace(match, may_be_fault=gain > 0.0)


def widen_match(
    grid: _core.OccupancyGrid2D,
    scan: Scan,
    priors: Sequence[MotionPrior],
    match: ScanMatch,
    usual: float,
) -> ScanMatch:
    """A pose outside the prior that is more likely although odometry rarely fails, or the match.

    Args:
        grid: the map so far.
        scan: its hits, at least one.
        priors: as of `match_scan`, and others if it fails.
        match: a poor match within the first one.
        usual: recent average of the explained share.
    """
    threshold = _WIDEN_BELOW * usual
    cost = match.cost + motion_cost(priors[0], match)
    for n_faults, window in enumerate(_WIDE_WINDOWS, start=1):
        for prior in priors:
            wide = motion_model.widen_prior(prior, *(half / _SEARCH_STDS for half in window))
            wider = search_within_prior(grid, scan, wide)
            cost_of_fault = wider.cost + motion_cost(wide, wider) + n_faults * FAULT_COST
            # at a place that only looks alike, beams would pass through walls
            is_alike = occluded_share(grid, scan, wider.T_map_base) > MAX_OCCLUDED
            if cost_of_fault < cost and not is_alike:
                match, cost = dataclasses.replace(wider, widened=True), cost_of_fault
        if match.explained >= threshold:
            break
    return _loosen_prior(grid, scan, priors[0], match)


def _loosen_prior(
    grid: _core.OccupancyGrid2D, scan: Scan, prior: MotionPrior, match: ScanMatch
) -> ScanMatch:
    """The match again with a wider prior, where odometry no longer holds."""
    if not prior.is_odometry or not is_inconsistent(prior, match.T_map_base):
        return match
    # a mean that far off would only pull the pose towards itself
    looser = motion_model.widen_prior(prior, *_distance(prior, match.T_map_base))
    again = refine_pose(grid, scan, looser, match.T_map_base)
    if again.cost <= match.cost:
        match = dataclasses.replace(again, widened=match.widened)
    contradicts = is_inconsistent(prior, match.T_map_base)
    return dataclasses.replace(match, contradicts_odometry=contradicts)


def accept_prior(prior: MotionPrior) -> ScanMatch:
    """The prior's mean and covariance, for a scan without a map to match."""
    covariance = np.asarray(np.linalg.inv(prior.information), np.float64)
    return ScanMatch(prior.T_map_base, covariance, 1.0, lambda: 0.0, np.zeros((0, 4)))


def _match_within_prior(
    grid: _core.OccupancyGrid2D, scan: Scan, prior: MotionPrior, usual: float
) -> ScanMatch:
    """The best pose within the prior's window; the optimum next to its mean if good enough."""
    local = refine_pose(grid, scan, prior, prior.T_map_base)
    if local.explained >= LOCAL_SHARE * usual:
        return local
    matches = local, search_within_prior(grid, scan, prior)
    return min(matches, key=lambda match: match.cost + motion_cost(prior, match))


def search_within_prior(grid: _core.OccupancyGrid2D, scan: Scan, prior: MotionPrior) -> ScanMatch:
    """The best pose in the window of a prior."""
    stds = prior.translation_std, prior.rotation_std
    return search_pose(grid, scan, prior, *(_SEARCH_STDS * std for std in stds))


def motion_cost(prior: MotionPrior, match: ScanMatch) -> float:
    """Nats of the motion of a scan: the prior's, and how much more it allowed than the scan does.

    With the cost of the scan, Laplace's approximation of the integral over poses:
    cost + 1/2 ln(det prior covariance / det posterior covariance).
    """
    volume = np.linalg.slogdet(match.covariance)[1] + np.linalg.slogdet(prior.information)[1]
    return prior.cost(match.T_map_base) - 0.5 * float(volume)


def _distance(prior: MotionPrior, T_map_base: Float) -> tuple[float, float]:
    d = prior.residual(T_map_base)
    return float(np.hypot(d[0], d[1])), abs(float(d[2]))


def is_inconsistent(prior: MotionPrior, T_map_base: Float) -> bool:
    """True if a pose (3, 3) is too far from a prior's mean for the prior to hold."""
    metres, radians = _distance(prior, T_map_base)
    off = max(metres / prior.translation_std, radians / prior.rotation_std)
    return off > _INCONSISTENT_STDS


def is_narrow(prior: MotionPrior) -> bool:
    """True if the window of a prior is no wider than the first of the wider searches."""
    stds = prior.translation_std, prior.rotation_std
    return all(_SEARCH_STDS * std <= half for std, half in zip(stds, _WIDE_WINDOWS[0], strict=True))


def search_pose(
    grid: _core.OccupancyGrid2D, scan: Scan, prior: MotionPrior, translation: float, rotation: float
) -> ScanMatch:
    """The best pose in a window of half widths `translation` (m) and `rotation` (rad)."""
    translation, rotation = min(translation, _MAX_WINDOW), min(rotation, float(np.pi))
    return _register(grid, scan, prior, window_translation=translation, window_rotation=rotation)


def refine_pose(
    grid: _core.OccupancyGrid2D, scan: Scan, prior: MotionPrior, start: Float
) -> ScanMatch:
    """The optimum that Newton steps from a pose (3, 3) reach."""
    return _register(grid, scan, prior, window_translation=0.0, window_rotation=0.0, T_start=start)


def _register(
    grid: _core.OccupancyGrid2D, scan: Scan, prior: MotionPrior, **search: Any
) -> ScanMatch:
    T, covariance, cost, explained, _, _, alternatives = _core.register_scan(
        grid,
        scan.points,
        scan.weights,
        prior.T_map_base,
        prior.information,
        **_newton_options(grid),
        search_range=_MAX_SEARCH_RANGE,
        max_candidates=_MAX_CANDIDATES,
        normals=scan.normals,
        isotropy=scan.isotropy,
        **search,
    )

    def compute_cost() -> float:  # most matches are never compared
        of_beams: float = cost + (_ray_cost(grid, scan, T) - prior.cost(T))
        return of_beams - _excess_of_unknown(grid, scan, T) if prior.is_odometry else of_beams

    return ScanMatch(T, covariance, explained, compute_cost, alternatives)


def _ray_cost(grid: _core.OccupancyGrid2D, scan: Scan, T_map_base: Float) -> float:
    """Nats of the beams that would pass through walls at a pose (3, 3)."""
    occluded = occluded_share(grid, scan, T_map_base) * float(scan.weights.sum(dtype=np.float64))
    return INFORMATION_SCALE * _OCCLUDED_COST * occluded


def _excess_of_unknown(grid: _core.OccupancyGrid2D, scan: Scan, T_map_base: Float) -> float:
    """Nats by which new end points cost more at a pose (3, 3) than they do at most.

    What is unknown behind a wall is not new.
    """
    ends = scan_hits.transform_points(scan.points, T_map_base)
    cells = np.floor(ends / grid.resolution).astype(np.int64)
    is_unknown = grid.alpha_beta(cells).sum(axis=1) <= 0.0
    points, weights = scan.points[is_unknown], scan.weights[is_unknown]
    unknown = dataclasses.replace(scan, points=points, weights=weights)
    hidden = occluded_share(grid, unknown, T_map_base, _NEAR_WALL)
    per_beam = -INFORMATION_SCALE * math.log((_FLOOR + _UNKNOWN) / (_FLOOR + 1.0))
    new = (1.0 - hidden) * float(weights.sum(dtype=np.float64))
    return max(per_beam * new - _MAX_UNKNOWN_COST, 0.0)


def registration_cost(grid: _core.OccupancyGrid2D, scan: Scan, T_map_base: Float) -> float:
    """Cost of the beams at a pose (3, 3), nats."""
    return INFORMATION_SCALE * _core.registration_cost(
        grid, scan.points, scan.weights, T_map_base, **_likelihood_field(grid)
    )


def refinement_options(grid: _core.OccupancyGrid2D) -> dict[str, Any]:
    """Options of the kernel that refines one scan after another."""
    normals = {"normal_radius": NORMALS["radius"], "normal_max_gap": NORMALS["max_gap"]}
    flat = {name: NORMALS[name] for name in ("flat_below", "round_from")}
    shared = {"correlation_length": scan_hits.CORRELATION_LENGTH}
    return {**_newton_options(grid), **scan_hits.INTERPOLATION, **normals, **flat, **shared}


def _newton_options(grid: _core.OccupancyGrid2D) -> dict[str, Any]:
    scale = {"information_scale": INFORMATION_SCALE, "max_iterations": _MAX_ITERATIONS}
    return {**_likelihood_field(grid), **scale}


def _likelihood_field(grid: _core.OccupancyGrid2D) -> dict[str, Any]:
    radius = max(1, round(2.0 * _FIELD_STD / grid.resolution))  # cells around an end point
    return {"sigma": _FIELD_STD, "radius": radius, "floor": _FLOOR, "unknown": _UNKNOWN}


def occluded_share(
    grid: _core.OccupancyGrid2D, scan: Scan, T_map_base: Float, margin: float = _WALL_MARGIN
) -> float:
    """Share of the beams that would pass through walls of the map at a pose (3, 3).

    Walls less than `margin` m before the end of a beam do not count.
    """
    return _core.occluded_share(
        grid,
        scan.points,
        scan.weights,
        T_map_base,
        scan.T_base_sensor,
        margin=margin,
        min_occupancy=WALL_OCCUPANCY,
    )
