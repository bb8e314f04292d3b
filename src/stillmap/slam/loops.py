"""Loops: keyframes that see again what the robot saw much earlier, and where that puts them."""

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap import _core, se2
from stillmap.options import field_with_doc
from stillmap.recording.model import Recording
from stillmap.slam import keyframes, motion, registration
from stillmap.slam.keyframes import Index
from stillmap.slam.registration import RegistrationOptions
from stillmap.slam.scans import Scan, SurfaceOptions, hits, in_frame, put

Float = NDArray[np.float64]

# of the way between keyframes: a local map of scans nearer than that takes longer, and says no more
_DENSE = 0.25
# metres by which a view is shifted to see whether it could slide along a wall
_SHIFTS = (-0.6, -0.3, 0.3, 0.6)


@dataclass(frozen=True)
class LoopOptions:
    """Loop closure; `docs/registration.md` says how."""

    enabled: bool = field_with_doc(True, "close loops; without, poses are incremental only")
    memory: float = field_with_doc(
        25.0, "m of travel that scans are registered against before loops are closed"
    )
    distance: float = field_with_doc(1.0, "m between keyframes")
    turn: float = field_with_doc(0.5, "rad between keyframes")
    gap: float = field_with_doc(15.0, "m of travel after which a place counts as seen again")
    reach: float = field_with_doc(6.0, "m, how near a keyframe must come to an earlier one")
    stretch: float = field_with_doc(8.0, "m of travel to either side that make a local map")
    view: float = field_with_doc(1.0, "m of travel to a scan on either side laid on it too")
    drift_translation: float = field_with_doc(0.006, "m of drift per metre: how far to search")
    drift_rotation: float = field_with_doc(0.0003, "rad of drift per metre: how far to search")
    drift_until: float = field_with_doc(
        1000.0, "m after which it is searched no farther: who drifts so far is lost"
    )
    window: float = field_with_doc(2.0, "standard deviations of the drift that are searched")
    stage: float = field_with_doc(
        40.0, "m of travel in which loops are looked for before the graph is solved, at least"
    )
    stage_share: float = field_with_doc(0.05, "of the travel so far, at least")
    step_translation: float = field_with_doc(0.03, "m of random error, per root of a metre")
    step_rotation: float = field_with_doc(0.004, "rad of random error, per root of a metre")
    sigma_translation: float = field_with_doc(0.03, "m, error of a closure at least")
    sigma_rotation: float = field_with_doc(0.006, "rad, error of a closure at least")
    accept_above: float = field_with_doc(0.5, "share of beams the earlier map must explain")
    compared: float = field_with_doc(0.8, "of the share that the map so far explains, at least")
    agreeing: int = field_with_doc(2, "closures around that must ask for the same correction")
    misfit: float = field_with_doc(16.0, "chi-square above which the graph refuses a closure")
    annealing: int = field_with_doc(
        8, "solutions in which the weights of closures grow sharp; 1: sharp at once"
    )
    sweeps: int = field_with_doc(1, "times that all scans are registered against all others")

    def __post_init__(self) -> None:
        for name, low, high in _LIMITS:
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"'slam.loops.{name}' wants {low:g} to {high:g}")


_LIMITS = (
    ("memory", 1.0, 1e9),
    ("distance", 0.05, 100.0),
    ("turn", 0.05, 100.0),
    ("gap", 1.0, 1e9),
    ("reach", 0.0, 100.0),
    ("stretch", 0.5, 1000.0),
    ("view", 0.0, 100.0),
    ("drift_translation", 0.0, 1.0),
    ("drift_rotation", 0.0, 1.0),
    ("drift_until", 0.0, 1e9),
    ("window", 0.0, 10.0),
    ("stage", 0.1, 1e9),
    ("stage_share", 0.0, 1e9),
    ("step_translation", 1e-4, 10.0),
    ("step_rotation", 1e-5, 10.0),
    ("sigma_translation", 1e-4, 10.0),
    ("sigma_rotation", 1e-5, 10.0),
    ("accept_above", 0.0, 1.0),
    ("compared", 0.0, 1.0),
    ("agreeing", 0, 100),
    ("misfit", 1e-3, 1e9),
    ("annealing", 1, 1000),
    ("sweeps", 0, 100),
)


@dataclass(frozen=True, eq=False)
class Candidate:
    """Two scans that may see the same place.

    Attributes:
        earlier, later: the scans.
        T: (3, 3) pose of the later one in the frame of the earlier one, as the graph has it.
        metres: of travel that the graph is as unsure of that as it is after.
    """

    earlier: int
    later: int
    T: Float
    metres: float


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
class Track:
    """What loops are looked for in: a recording, its weights and the poses so far.

    Attributes:
        e: (M,) probability that each beam was reflected by something static.
        poses: (T, 3, 3) T_map_base.
        travelled: (T,) metres up to each scan.
        explained: (T,) share of each scan that the map so far explained.
        keyframes: (K,) indices of scans.
    """

    recording: Recording
    e: NDArray[np.float32]
    poses: Float
    travelled: Float
    explained: Float
    keyframes: Index
    resolution: float
    registration: RegistrationOptions
    surface: SurfaceOptions
    options: LoopOptions


def attempts(track: Track, candidates: Iterable[Candidate]) -> list[Closure]:
    """Every candidate laid on the map of an earlier stretch; ordered by the later scan."""
    of_stretch: dict[int, list[Candidate]] = {}
    for candidate in candidates:
        stretch = round(track.travelled[candidate.earlier] / track.options.stretch)
        of_stretch.setdefault(stretch, []).append(candidate)
    found = []
    for stretch, those in sorted(of_stretch.items()):
        grid = local_map(track, stretch * track.options.stretch)
        for candidate in those:
            found.append(laid_on(track, grid, candidate, *drift(candidate.metres, track.options)))
    return sorted(found, key=lambda closure: closure.later)


def drift(metres: float, options: LoopOptions) -> tuple[float, float]:
    """Standard deviations of place and heading after a way, in metres and radians."""
    metres = min(metres, options.drift_until)
    return (
        float(np.hypot(0.1, options.drift_translation * metres)),
        float(np.hypot(0.02, options.drift_rotation * metres)),
    )


def local_map(track: Track, centre: float) -> _core.Grid2D:
    """Scans of one stretch of travel, and no others."""
    half = track.options.stretch
    first, last = np.searchsorted(track.travelled, [centre - half, centre + half])
    grid = _core.Grid2D(track.resolution, track.registration.approach)
    spacing = _DENSE * track.options.distance, _DENSE * track.options.turn
    sensor = track.recording.sensor[first:last]
    for t in first + keyframes.chosen_of_each(track.poses[first:last], sensor, *spacing):
        put(grid, track.recording, track.e, t, track.poses[t], track.surface)
    return grid


def _view(track: Track, t: int) -> Scan:
    """What a keyframe and a scan to either side see, in its frame."""
    here, half = track.travelled[t], track.options.view
    first, last = np.searchsorted(track.travelled, [here - half, here + half], side="right")
    last = max(last - 1, t)
    shown = sorted({min(first, t), t, last})
    seen = [hits(track.recording, track.e, s) for s in shown]
    to_t = se2.inverse(track.poses[t]) @ track.poses[shown]
    points = [in_frame(scan.points, T) for scan, T in zip(seen, to_t, strict=True)]
    weights = np.concatenate([scan.weights for scan in seen])
    return Scan(np.concatenate(points), weights, track.recording.T_base_sensor[0])


def laid_on(
    track: Track, grid: _core.Grid2D, candidate: Candidate, sigma: float, sigma_turn: float
) -> Closure:
    """The later view registered on the earlier map, as widely as it may have drifted.

    Args:
        track: where loops are looked for.
        grid: the map of an earlier stretch.
        candidate: the scans, and where the later one is looked for.
        sigma, sigma_turn: standard deviations of that, in metres and radians.
    """
    options, earlier, later = track.options, candidate.earlier, candidate.later
    prior = motion.guess_at(track.poses[earlier] @ candidate.T, sigma, sigma_turn)
    view = _view(track, later)
    window = options.window * sigma, min(options.window * sigma_turn, np.pi)
    found = registration.search(grid, view, prior, track.registration, *window)
    least = [options.sigma_translation] * 2 + [options.sigma_rotation]
    covariance = found.covariance + np.diag(np.square(least))
    too_little = found.explained < max(
        options.accept_above, options.compared * track.explained[later]
    )
    if not too_little:
        # what the graph knows of the place is no second witness: the whole way bounds it here
        free = drift(track.travelled[later] - track.travelled[earlier], options)[0]
        covariance += _sliding(grid, view, found.T_map_base, covariance, free, track.registration)
        covariance += _ambiguous(found.rivals)
    return Closure(
        earlier,
        later,
        se2.inverse(track.poses[earlier]) @ found.T_map_base,
        se2.turned(covariance, se2.inverse(found.T_map_base)),
        found.explained,
        "explains too little" if too_little else "",
    )


def _ambiguous(rivals: Float) -> Float:
    """Covariance (3, 3) to add where the view fits somewhere else about as well.

    That of a mixture about its best part, each part being as probable as its cost says.
    """
    p = np.exp(-rivals[:, 3])
    p /= p.sum()
    apart = rivals[:, :3]
    spread: Float = np.einsum("r,ri,rj->ij", p, apart, apart)
    return spread


def _sliding(
    grid: _core.Grid2D,
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
            radius=registration.radius(options, grid.resolution),
            floor=options.floor,
            unknown=options.unknown,
        )

    best = cost(0.0)
    # a Gaussian of this variance loses as much there
    variances = [0.5 * shift**2 / max(cost(shift) - best, 1e-9) for shift in _SHIFTS]
    added = np.zeros((3, 3))
    added[:2, :2] = min(max(variances), sigma**2) * np.outer(along, along)
    return added


def refuse(closure: Closure, reason: str) -> Closure:
    """The same, not accepted."""
    return dataclasses.replace(closure, refused=reason)
