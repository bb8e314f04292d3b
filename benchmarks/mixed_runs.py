"""Runs of mixed worlds, lasers, crowds, resolutions, estimators and poses, drawn by their seed."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from cases import Case, scaled_odometry
from common import options_of
from numpy.typing import NDArray

import stillmap
from stillmap.core import se2
from stillmap.core.config import merge_nested
from stillmap.sim import Simulation

Float = NDArray[np.float64]

SCANS = 350
# speed in m/s and scans per second, such that the scans cover most of the route or a loop of it
WORLDS = {
    "hall": (0.5, 1.0),
    "corridor": (0.5, 1.0),
    "office": (0.5, 1.5),
    "warehouse": (0.6, 1.0),
    "gallery": (0.5, 2.0),
    "street": (None, 5.0),
    "drive": (None, 4.0),
    "ten-corridors": (1.0, 1.0),
    "rounds": (1.5, 1.5),
}
LASERS = {
    "180 deg, 30 m": {},
    "90 deg, 30 m": {"beams": 181, "fov": math.radians(90), "range_noise": 0.01},
    "360 deg, 12 m": {"beams": 360, "fov": math.radians(360), "max_range": 12.0},
    "270 deg, 8 m": {"beams": 271, "fov": math.radians(270), "max_range": 8.0},
    "180 deg, 80 m, 5 cm": {"beams": 361, "max_range": 80.0, "range_noise": 0.05},
}
PEOPLE = (5, 15, 40)
RESOLUTIONS = (0.03, 0.05, 0.05, 0.1, 0.2)
METHODS = ("stillmap", "stillmap", "stillmap", "paper", "hit-ratio-0.25", "tracker")
NONE, GIVEN_ODOMETRY, GIVEN_DRIFT = "none", "given: odometry", "given: true with drift"
ODOMETRY: dict[str, dict[str, Any]] = {
    "good": scaled_odometry(0.3),
    "normal": {},
    "3x worse": scaled_odometry(3.0),
    "slips": scaled_odometry(1.0, slip_rate=0.1),
    "stalls": scaled_odometry(1.0, stall_rate=1.0),
    NONE: {},
    GIVEN_ODOMETRY: {},
    GIVEN_DRIFT: {},
}
_DRIFT = (0.02, 0.006)  # m and rad per sqrt(scan)


@dataclass(frozen=True)
class MixedRun:
    """One run; every property is drawn by the seed."""

    seed: int
    world: str
    laser: str
    people: int
    resolution: float
    method: str
    odometry: str

    def case(self) -> Case:
        """Its world, laser, crowd and odometry."""
        speed, rate = WORLDS[self.world]
        robot: dict[str, Any] = {"scans": SCANS, "scan_rate": rate}
        changes = merge_nested(
            {"robot": robot if speed is None else {**robot, "speed": speed}},
            {"laser": LASERS[self.laser], "crowd": {"people": self.people}},
            ODOMETRY[self.odometry],
        )
        return Case(str(self), "mixed", self.world, changes)

    def options(self) -> stillmap.Options:
        """Method and resolution."""
        return options_of(self.method, [f"slam.resolution={self.resolution}"])

    def inputs(self, simulation: Simulation) -> tuple[stillmap.Recording, Float | None]:
        """The recording as it is mapped, and the poses given."""
        recording, truth = simulation.recording, simulation.truth
        if self.odometry == NONE:
            return recording.without_odometry(), None
        if self.odometry == GIVEN_ODOMETRY:
            return recording, recording.T_odom_base
        if self.odometry == GIVEN_DRIFT:
            return recording, drifted(truth.T_world_base, np.random.default_rng([self.seed, 2]))
        return recording, None


def draw(seed: int) -> MixedRun:
    """The run of a seed."""
    rng = np.random.default_rng([seed, 28])

    def one(values: Any) -> Any:
        values = list(values)
        return values[int(rng.integers(len(values)))]

    return MixedRun(
        seed, one(WORLDS), one(LASERS), one(PEOPLE), one(RESOLUTIONS), one(METHODS), one(ODOMETRY)
    )


def drifted(poses: Float, rng: np.random.Generator) -> Float:
    """Poses (T, 3, 3) with errors of each step that add up."""
    steps = se2.inverse(poses[:-1]) @ poses[1:]
    off = rng.standard_normal((len(steps), 3)) * (_DRIFT[0], _DRIFT[0], _DRIFT[1])
    out = np.empty_like(poses)
    out[0] = poses[0]
    for t, step in enumerate(steps @ se2.matrix(*off.T)):
        out[t + 1] = out[t] @ step
    return se2.normalize(out)
