"""Loops: what is looked for in what, what may be found, and what was."""

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.core.config import option
from stillmap.core.recording import Recording
from stillmap.slam.local_map import Index
from stillmap.slam.scan_matching import RegistrationOptions, SurfaceOptions

Float = NDArray[np.float64]


@dataclass(frozen=True)
class LoopOptions:
    """Loop closure; `docs/registration.md` says how."""

    enabled: bool = option(True, "close loops; without, poses are incremental only")
    memory: float = option(
        25.0, "m of travel that scans are registered against before loops are closed"
    )
    distance: float = option(1.0, "m between keyframes")
    turn: float = option(0.5, "rad between keyframes")
    gap: float = option(15.0, "m of travel after which a place counts as seen again")
    reach: float = option(
        6.0, "m, how near a keyframe, or where it looks, must come to an earlier one"
    )
    stretch: float = option(8.0, "m of travel to either side that make a local map")
    view: float = option(1.0, "m of travel to a scan on either side laid on it too")
    drift_translation: float = option(0.006, "m of drift per metre: how far to search")
    drift_rotation: float = option(0.0003, "rad of drift per metre: how far to search")
    drift_until: float = option(
        1000.0, "m after which it is searched no farther: who drifts so far is lost"
    )
    window: float = option(2.0, "standard deviations of the drift that are searched")
    stage: float = option(
        40.0, "m of travel in which loops are looked for before the graph is solved, at least"
    )
    stage_share: float = option(0.05, "of the travel so far, at least")
    step_translation: float = option(0.03, "m of random error, per root of a metre")
    step_rotation: float = option(0.004, "rad of random error, per root of a metre")
    sigma_translation: float = option(0.03, "m, error of a closure at least")
    sigma_rotation: float = option(0.006, "rad, error of a closure at least")
    before: float = option(
        1.0, "m before its end where the earlier map must have looked, or a beam is not comparable"
    )
    known: float = option(0.4, "share of beams that must be comparable")
    accept_above: float = option(0.5, "share of those that the earlier map must explain")
    compared: float = option(0.8, "of the share that the map so far explains, at least")
    agreeing: int = option(2, "closures around that must ask for the same correction")
    misfit: float = option(16.0, "chi-square above which the graph refuses a closure")
    annealing: int = option(
        8, "solutions in which the weights of closures grow sharp; 1: sharp at once"
    )
    sweeps: int = option(1, "times that all scans are registered against all others")

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
    ("before", 0.0, 100.0),
    ("known", 0.0, 1.0),
    ("accept_above", 0.0, 1.0),
    ("compared", 0.0, 1.0),
    ("agreeing", 0, 100),
    ("misfit", 1e-3, 1e9),
    ("annealing", 1, 1000),
    ("sweeps", 0, 100),
)


@dataclass(frozen=True, eq=False)
class LoopCandidate:
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
class LoopClosure:
    """One attempt at closing a loop.

    Attributes:
        earlier, later: scans that see the same place.
        T: (3, 3) pose of the later scan in the frame of the earlier one.
        covariance: (3, 3) of x, y, heading in the frame of the later scan.
        explained: share of the later beams that the earlier ones explain, of those that are
            comparable.
        refused: why it was not accepted; empty when it was.
    """

    earlier: int
    later: int
    T: Float
    covariance: Float
    explained: float
    refused: str = ""


@dataclass(frozen=True, eq=False)
class LoopContext:
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


def drift(metres: float, options: LoopOptions) -> tuple[float, float]:
    """Standard deviations of place and heading after a way, in metres and radians."""
    metres = min(metres, options.drift_until)
    return (
        float(np.hypot(0.1, options.drift_translation * metres)),
        float(np.hypot(0.02, options.drift_rotation * metres)),
    )


def refuse(closure: LoopClosure, reason: str) -> LoopClosure:
    """The same, not accepted."""
    return dataclasses.replace(closure, refused=reason)
