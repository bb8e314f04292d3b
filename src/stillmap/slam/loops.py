"""Loops: keyframes that see again what the robot saw much earlier, found and verified."""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap import _core, se2
from stillmap.options import field_with_doc
from stillmap.recording.model import Recording
from stillmap.slam import keyframes, registration
from stillmap.slam.keyframes import Index
from stillmap.slam.motion import MotionPrior
from stillmap.slam.registration import RegistrationOptions
from stillmap.slam.scans import hits, in_frame, put

Float = NDArray[np.float64]
Points = NDArray[np.float32]


@dataclass(frozen=True)
class LoopOptions:
    """Loop closure; `docs/registration.md` says how."""

    enabled: bool = field_with_doc(True, "close loops; without, poses are incremental only")
    distance: float = field_with_doc(1.0, "m between keyframes")
    turn: float = field_with_doc(0.5, "rad between keyframes")
    gap: float = field_with_doc(15.0, "m of travel after which a place counts as seen again")
    reach: float = field_with_doc(4.0, "m, how near a keyframe must come to an earlier one")
    stretch: float = field_with_doc(8.0, "m of travel to either side that make a local map")
    view: float = field_with_doc(1.0, "m of travel to either side whose scans are laid on it")
    memory: float = field_with_doc(1e9, "m of travel the incremental map remembers")
    drift_translation: float = field_with_doc(0.006, "m of drift per metre travelled")
    drift_rotation: float = field_with_doc(0.0003, "rad of drift per metre travelled")
    step_translation: float = field_with_doc(0.03, "m of random error, per root of a metre")
    step_rotation: float = field_with_doc(0.004, "rad of random error, per root of a metre")
    window: float = field_with_doc(2.0, "standard deviations of the drift that are searched")
    accept_above: float = field_with_doc(0.5, "share of beams the earlier map must explain")
    compared: float = field_with_doc(0.8, "of the share that the map so far explains, at least")
    agreeing: int = field_with_doc(2, "keyframes around that must ask for the same correction")
    sigma_translation: float = field_with_doc(0.03, "m, error of a closure at least")
    sigma_rotation: float = field_with_doc(0.006, "rad, error of a closure at least")
    robust: float = field_with_doc(1.5, "standard deviations where Cauchy's loss sets in")
    misfit: float = field_with_doc(16.0, "chi-square above which the graph refuses a closure")
    rounds: int = field_with_doc(2, "times that loops are looked for, each after the graph")
    sweeps: int = field_with_doc(1, "times that all scans are registered against all others")


@dataclass(frozen=True, eq=False)
class Closure:
    """One attempt at closing a loop.

    Attributes:
        earlier, later: scans that see the same place.
        T: (3, 3) pose of the later scan in the frame of the earlier one.
        covariance: (3, 3) of x, y, heading in the frame of the later scan.
        explained: share of the later beams that the earlier ones explain.
        refused: why it was not accepted; empty when it was.
    """

    earlier: int
    later: int
    T: Float
    covariance: Float
    explained: float
    refused: str = ""


@dataclass(frozen=True, eq=False)
class Search:
    """What looking for loops works on: a recording, its weights and the poses so far."""

    recording: Recording
    e: NDArray[np.float32]
    poses: Float
    at: Float  # (T,) metres travelled
    keyframes: Index
    explained: Float  # (T,)
    resolution: float
    registration: RegistrationOptions
    options: LoopOptions


def attempts(search: Search) -> list[Closure]:
    """All candidates registered, each accepted or refused; ordered by the later scan."""
    found = []
    by_place: dict[int, list[tuple[int, int]]] = {}
    for earlier, later in _candidates(search):
        place = round(search.at[earlier] / search.options.stretch)
        by_place.setdefault(place, []).append((earlier, later))
    for place, pairs in sorted(by_place.items()):
        grid = _local_map(search, place * search.options.stretch)
        found += [_registered(search, grid, *pair) for pair in pairs]
    found.sort(key=lambda closure: closure.later)
    return _agreeing(search, found)


def _candidates(search: Search) -> Iterator[tuple[int, int]]:
    """Keyframe and the nearest one of much earlier travel, when it lies within reach."""
    options, frames = search.options, search.keyframes
    x = se2.parameters(search.poses[frames])
    at = search.at[frames]
    for k in range(len(frames)):
        n = int(np.searchsorted(at, at[k] - options.gap))
        if n == 0:
            continue
        distance = np.linalg.norm(x[:n, :2] - x[k, :2], axis=1)
        turned = np.abs(se2.wrap(x[:n, 2] - x[k, 2]))
        i = int(np.argmin(distance + turned))  # seen from the same side, where there is a choice
        if distance[i] < options.reach + _drift(at[k] - at[i], options)[0]:
            yield int(frames[i]), int(frames[k])


def _drift(metres: float, options: LoopOptions) -> tuple[float, float]:
    """Standard deviations of x or y and heading after a way."""
    return (
        float(np.hypot(0.1, options.drift_translation * metres)),
        float(np.hypot(0.02, options.drift_rotation * metres)),
    )


def _local_map(search: Search, centre: float) -> _core.Grid2D:
    """Scans within a stretch of travel, and no others."""
    first, last = np.searchsorted(
        search.at, [centre - search.options.stretch, centre + search.options.stretch]
    )
    grid = _core.Grid2D(search.resolution, search.registration.approach)
    for t in range(first, last):
        put(grid, search.recording, search.e, t, search.poses[t])
    return grid


def _view(search: Search, t: int) -> tuple[Points, NDArray[np.float32]]:
    """End points of a keyframe and of a few scans around it, in its frame, with their e."""
    view = search.options.view
    first, last = np.searchsorted(search.at, [search.at[t] - view, search.at[t] + view])
    chosen = sorted({t, first, (first + t) // 2, (t + last) // 2, max(last - 1, t)})
    points, weights = [], []
    for s in chosen:
        p, w = hits(search.recording, search.e, s)
        points.append(in_frame(p, se2.inverse(search.poses[t]) @ search.poses[s]))
        weights.append(w)
    return np.concatenate(points), np.concatenate(weights)


def _registered(search: Search, grid: _core.Grid2D, earlier: int, later: int) -> Closure:
    options = search.options
    sigma, sigma_turn = _drift(search.at[later] - search.at[earlier], options)
    information = np.diag([sigma**-2, sigma**-2, sigma_turn**-2])
    prior = MotionPrior(search.poses[later], information, sigma, sigma_turn)
    points, weights = _view(search, later)
    window = options.window * sigma, options.window * sigma_turn
    found = registration.search(grid, points, weights, prior, search.registration, *window)
    T = found.T_map_base
    covariance = found.covariance + _least(options)
    covariance = covariance + _slides(search, grid, points, weights, T, covariance, sigma)
    turned = np.eye(3)
    turned[:2, :2] = T[:2, :2].T
    closure = Closure(
        earlier,
        later,
        se2.inverse(search.poses[earlier]) @ T,
        turned @ covariance @ turned.T,
        found.explained,
    )
    if found.explained < max(options.accept_above, options.compared * search.explained[later]):
        return dataclasses.replace(closure, refused="explains too little")
    return closure


def _least(options: LoopOptions) -> Float:
    return np.diag(
        [options.sigma_translation**2, options.sigma_translation**2, options.sigma_rotation**2]
    )


def _slides(
    search: Search,
    grid: _core.Grid2D,
    points: Points,
    weights: NDArray[np.float32],
    T: Float,
    covariance: Float,
    sigma: float,
) -> Float:
    """Covariance (3, 3) to add where the scan could slide along a wall without a worse fit.

    The curvature at the optimum takes the pattern of end points on a bare wall for information;
    what the fit loses further off does not.
    """
    r = search.registration
    axis = np.linalg.eigh(covariance[:2, :2])[1][:, 1]  # the direction known least

    def cost(shift: float) -> float:
        moved = T.copy()
        moved[:2, 2] += shift * axis
        radius = max(1, round(2.0 * r.sigma / search.resolution))
        return r.gain * _core.registration_cost(
            grid,
            points,
            weights,
            moved,
            sigma=r.sigma,
            radius=radius,
            floor=r.floor,
            unknown=r.unknown,
        )

    best = cost(0.0)
    spread = 0.0
    for shift in (-0.6, -0.45, -0.3, -0.15, 0.15, 0.3, 0.45, 0.6):
        lost = max(cost(shift) - best, 0.0)
        # a Gaussian that loses as much there: 1/2 shift^2 / variance
        spread = max(spread, min(0.5 * shift**2 / max(lost, 1e-9), sigma**2))
    added = np.zeros((3, 3))
    added[:2, :2] = spread * np.outer(axis, axis)
    return added


def _agreeing(search: Search, found: list[Closure]) -> list[Closure]:
    """Refuses closures whose correction the closures of keyframes nearby do not ask for."""
    out = []
    candidates = [c for c in found if not c.refused]
    for closure in found:
        if not closure.refused:
            near = [
                other
                for other in candidates
                if other is not closure
                and abs(search.at[other.later] - search.at[closure.later])
                < 4.0 * search.options.distance
                and abs(search.at[other.earlier] - search.at[closure.earlier])
                < 8.0 * search.options.distance
            ]
            agree = sum(_agree(search, closure, other) for other in near)
            if agree < search.options.agreeing or 2 * agree < len(near):
                closure = dataclasses.replace(closure, refused="no agreement around")
        out.append(closure)
    return out


def _agree(search: Search, a: Closure, b: Closure) -> bool:
    P = search.poses
    moved_a, moved_b = P[a.earlier] @ a.T, P[b.earlier] @ b.T
    predicted = moved_b @ se2.inverse(P[b.later]) @ P[a.later]
    d = se2.parameters(se2.inverse(predicted) @ moved_a)
    R = np.eye(3)
    R[:2, :2] = (se2.inverse(P[a.later]) @ P[b.later])[:2, :2]
    covariance = a.covariance + R @ b.covariance @ R.T
    return float(d @ np.linalg.solve(covariance, d)) < 9.0
