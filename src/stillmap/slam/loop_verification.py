"""A keyframe laid on the map of an earlier stretch: whether it fits, and where that puts it."""

import dataclasses
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core import se2
from stillmap.slam import motion_model, scan_matching
from stillmap.slam.local_map import select_keyframes_per_sensor
from stillmap.slam.loop_types import LoopCandidate, LoopClosure, LoopContext, drift
from stillmap.slam.scan_matching import (
    Points,
    RegistrationOptions,
    Scan,
    add_scan,
    select_hits,
    transform_points,
)

Float = NDArray[np.float64]

# of the way between keyframes: a local map of scans nearer than that takes longer, and says no more
_DENSE = 0.25
# metres by which a view is shifted to see whether it could slide along a wall
_SHIFTS = (-0.6, -0.3, 0.3, 0.6)
# times that a view is laid on a map, at most: again if, where it came to lie, other beams than
# before are comparable; and the share of them that does not count
_ROUNDS, _SAME = 3, 0.05


def verify_candidates(track: LoopContext, candidates: Iterable[LoopCandidate]) -> list[LoopClosure]:
    """Every candidate laid on the map of an earlier stretch; ordered by the later scan."""
    of_stretch: dict[int, list[LoopCandidate]] = {}
    for candidate in candidates:
        stretch = round(track.travelled[candidate.earlier] / track.options.stretch)
        of_stretch.setdefault(stretch, []).append(candidate)
    found = []
    for stretch, those in sorted(of_stretch.items()):
        grid = build_submap(track, stretch * track.options.stretch)
        for candidate in those:
            found.append(
                verify_candidate(track, grid, candidate, *drift(candidate.metres, track.options))
            )
        track.recording.release_pages(track.e)
    return sorted(found, key=lambda closure: closure.later)


def build_submap(track: LoopContext, centre: float) -> _core.OccupancyGrid2D:
    """Scans of one stretch of travel, and no others."""
    half = track.options.stretch
    first, last = np.searchsorted(track.travelled, [centre - half, centre + half])
    grid = _core.OccupancyGrid2D(track.resolution, track.registration.approach)
    spacing = _DENSE * track.options.distance, _DENSE * track.options.turn
    sensor = track.recording.sensor[first:last]
    for t in first + select_keyframes_per_sensor(track.poses[first:last], sensor, *spacing):
        add_scan(grid, track.recording, track.e, t, track.poses[t], track.surface)
    return grid


def _view(track: LoopContext, t: int) -> tuple[Scan, Points]:
    """What a keyframe and a scan to either side see, in its frame; and where beams were before.

    The latter are (N, 2): `LoopOptions.before` metres before their ends, or half way if that is
    farther out.
    """
    here, half = track.travelled[t], track.options.view
    first, last = np.searchsorted(track.travelled, [here - half, here + half], side="right")
    last = max(last - 1, t)
    shown = sorted({min(first, t), t, last})
    seen = [select_hits(track.recording, track.e, s) for s in shown]
    to_t = se2.inverse(track.poses[t]) @ track.poses[shown]
    points = [transform_points(scan.points, T) for scan, T in zip(seen, to_t, strict=True)]
    before = [
        transform_points(_points_before_ends(scan, track.options.before), T)
        for scan, T in zip(seen, to_t, strict=True)
    ]
    weights = np.concatenate([scan.weights for scan in seen])
    view = Scan(np.concatenate(points), weights, track.recording.T_base_sensor[0])
    return view, np.concatenate(before)


def _points_before_ends(scan: Scan, metres: float) -> Points:
    """(N, 2) where the beams of a scan were so far before their ends, in its frame."""
    origin = scan.T_base_sensor[:2, 2].astype(np.float32)
    beams = scan.points - origin
    length = np.linalg.norm(beams, axis=1, keepdims=True).clip(1e-6)
    before: Points = origin + beams * np.maximum(0.5, 1.0 - metres / length)
    return before


def _comparable(
    grid: _core.OccupancyGrid2D, view: Scan, before: Points, T: Float
) -> tuple[Scan, float]:
    """What of a view the map has looked at from the same side, and its share of the view.

    The rest says nothing of whether the view fits, and draws it astray: the back of a wall is not
    its front.
    """
    cells = np.floor(transform_points(before, T) / grid.resolution).astype(np.int64)
    looked_at = grid.alpha_beta(cells).sum(axis=1) > 0.0
    part = np.where(looked_at, view.weights, np.float32(0.0))
    share = float(part.sum()) / max(float(view.weights.sum()), 1e-9)
    return dataclasses.replace(view, weights=part), share


def verify_candidate(
    track: LoopContext,
    grid: _core.OccupancyGrid2D,
    candidate: LoopCandidate,
    sigma: float,
    sigma_turn: float,
) -> LoopClosure:
    """The later view registered on the earlier map, as widely as it may have drifted.

    Args:
        track: where loops are looked for.
        grid: the map of an earlier stretch.
        candidate: the scans, and where the later one is looked for.
        sigma, sigma_turn: standard deviations of that, in metres and radians.
    """
    options, earlier, later = track.options, candidate.earlier, candidate.later
    prior = motion_model.gaussian_prior(track.poses[earlier] @ candidate.T, sigma, sigma_turn)
    view, before = _view(track, later)
    window = options.window * sigma, min(options.window * sigma_turn, np.pi)
    part, share = _comparable(grid, view, before, prior.T_map_base)
    for _ in range(_ROUNDS):
        found = scan_matching.search_pose(grid, part, prior, track.registration, *window)
        here, share = _comparable(grid, view, before, found.T_map_base)
        if np.abs(here.weights - part.weights).sum() < _SAME * view.weights.sum():
            break
        part = here
    least = [options.sigma_translation] * 2 + [options.sigma_rotation]
    covariance = found.covariance + np.diag(np.square(least))
    too_little = share < options.known or found.explained < max(
        options.accept_above, options.compared * track.explained[later]
    )
    if not too_little:
        # what the graph knows of the place is no second witness: the whole way bounds it here
        free = drift(track.travelled[later] - track.travelled[earlier], options)[0]
        covariance += _sliding(grid, part, found.T_map_base, covariance, free, track.registration)
        covariance += _ambiguity_covariance(found.rivals)
    return LoopClosure(
        earlier,
        later,
        se2.inverse(track.poses[earlier]) @ found.T_map_base,
        se2.rotate_covariance(covariance, se2.inverse(found.T_map_base)),
        found.explained,
        "explains too little" if too_little else "",
    )


def _ambiguity_covariance(rivals: Float) -> Float:
    """Covariance (3, 3) to add where the view fits somewhere else about as well.

    That of a mixture about its best part, each part being as probable as its cost says.
    """
    p = np.exp(-rivals[:, 3])
    p /= p.sum()
    apart = rivals[:, :3]
    spread: Float = np.einsum("r,ri,rj->ij", p, apart, apart)
    return spread


def _sliding(
    grid: _core.OccupancyGrid2D,
    view: Scan,
    T: Float,
    covariance: Float,
    sigma: float,
    options: RegistrationOptions,
) -> Float:
    """Covariance (3, 3) to add where a view could slide along a wall and fit as well.

    The curvature at the optimum takes the pattern of end points on a bare wall for information.
    What the fit loses some way off cannot be taken in like that.
    """
    along = np.linalg.eigh(covariance[:2, :2])[1][:, 1]  # the direction that is known least

    def cost(shift: float) -> float:
        moved = T.copy()
        moved[:2, 2] += shift * along
        return options.gain * _core.registration_cost(
            grid,
            view.points,
            view.weights,
            moved,
            sigma=options.sigma,
            radius=scan_matching.field_radius(options, grid.resolution),
            floor=options.floor,
            unknown=options.unknown,
        )

    best = cost(0.0)
    # a Gaussian of this variance loses as much there
    variances = [0.5 * shift**2 / max(cost(shift) - best, 1e-9) for shift in _SHIFTS]
    added = np.zeros((3, 3))
    added[:2, :2] = min(max(variances), sigma**2) * np.outer(along, along)
    return added
