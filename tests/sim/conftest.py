"""Runs of populated worlds, shared by the tests."""

import functools
from collections.abc import Callable

import numpy as np
import pytest
from marks import slow_params
from numpy.typing import NDArray

from stillmap.sim import Simulation, scene_by_name, simulate
from stillmap.sim.planner import compute_segment_distance

Float = NDArray[np.float64]

# scans that show enough of a world; none: its whole route
WORLDS: dict[str, dict[str, float]] = {
    "office": {"scans": 500},
    "warehouse": {"scans": 300},
    "street": {"scans": 400},
    "street-turn": {},
    "drive": {"scan_rate": 10.0},
}


@functools.cache
def _run(name: str) -> Simulation:
    if name in WORLDS:
        laser = {"beams": 91, "range_noise": 0.0, "no_return_share": 0.0}
        return simulate(scene_by_name(name, {"laser": laser, "robot": WORLDS[name]}), 3)
    if name != "crowded":
        return simulate(scene_by_name(name), 3)
    people = {"people": 60, "stopping_share": 1.0, "max_stop": 60.0, "shape": "legs"}
    return simulate(scene_by_name("corridor", {"crowd": people, "robot": {"scans": 1500}}), 5)


@pytest.fixture(params=["hall", "corridor"])
def populated(request: pytest.FixtureRequest) -> Simulation:
    """The whole route, once, with the usual number of people."""
    return _run(request.param)


@pytest.fixture
def crowded() -> Simulation:
    """A corridor full of people who all stop and stand, seen as legs."""
    return _run("crowded")


@pytest.fixture(params=["hall", "corridor", "crowded"])
def any_run(request: pytest.FixtureRequest) -> Simulation:
    """Each of them."""
    return _run(request.param)


@pytest.fixture(params=[name for name in WORLDS if name != "drive"] + slow_params("drive"))
def world(request: pytest.FixtureRequest) -> Simulation:
    """The worlds in which not only people move, seen without noise."""
    return _run(request.param)


@pytest.fixture
def run() -> Callable[[str], Simulation]:
    """One of the runs by name."""
    return _run


@pytest.fixture
def wall_distance() -> Callable[[Float, Float], Float]:
    """Metres from points (N, 2) to the nearest of the walls (W, 4)."""

    def distance(points: Float, walls: Float) -> Float:
        nearest = np.full(len(points), np.inf)
        for wall in walls:
            np.minimum(nearest, compute_segment_distance(points, wall), out=nearest)
        return nearest

    return distance


@pytest.fixture
def end_points() -> Callable[[Simulation], tuple[Float, NDArray[np.int64]]]:
    """(M, 2) in the world at true poses, and the scan of each beam."""

    def points(simulation: Simulation) -> tuple[Float, NDArray[np.int64]]:
        recording = simulation.recording
        scan = np.repeat(np.arange(recording.n_scans), np.diff(recording.offset))
        T = recording.T_map_sensor(simulation.truth.T_world_base)[scan]
        return np.einsum("nij,nj->ni", T[:, :2, :2], recording.points) + T[:, :2, 2], scan

    return points
