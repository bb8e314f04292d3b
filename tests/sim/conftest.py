"""Runs of populated worlds, shared by the tests."""

import functools

import numpy as np
import pytest
from marks import slow_params

from stillmap.core.config import override
from stillmap.sim import Scene, scene_by_name, simulate
from stillmap.sim.planner import compute_segment_distance
from stillmap.sim.walls import box, pillar

# scans that show enough of a world; none: its whole route
WORLDS = {
    "office": {"scans": 500},
    "warehouse": {"scans": 300},
    "street": {"scans": 400},
    "street-turn": {},
    "drive": {"scan_rate": 10.0},
}


@functools.cache
def _run(name):
    if name in WORLDS:
        laser = {"beams": 91, "range_noise": 0.0, "no_return_share": 0.0}
        return simulate(scene_by_name(name, {"laser": laser, "robot": WORLDS[name]}), 3)
    if name != "crowded":
        return simulate(scene_by_name(name), 3)
    people = {"people": 60, "stopping_share": 1.0, "max_stop": 60.0, "shape": "legs"}
    return simulate(scene_by_name("corridor", {"crowd": people, "robot": {"scans": 1500}}), 5)


@pytest.fixture(params=["hall", "corridor"])
def populated(request):
    """The whole route, once, with the usual number of people."""
    return _run(request.param)


@pytest.fixture
def crowded():
    """A corridor full of people who all stop and stand, seen as legs."""
    return _run("crowded")


@pytest.fixture(params=["hall", "corridor", "crowded"])
def any_run(request):
    """Each of them."""
    return _run(request.param)


@pytest.fixture(params=[name for name in WORLDS if name != "drive"] + slow_params("drive"))
def world(request):
    """The worlds in which not only people move, seen without noise."""
    return _run(request.param)


@pytest.fixture
def run():
    """One of the runs by name."""
    return _run


@pytest.fixture
def wall_distance():
    """Metres from points (N, 2) to the nearest of the walls (W, 4)."""

    def distance(points, walls):
        nearest = np.full(len(points), np.inf)
        for wall in walls:
            np.minimum(nearest, compute_segment_distance(points, wall), out=nearest)
        return nearest

    return distance


@pytest.fixture
def end_points():
    """(M, 2) in the world at true poses, and the scan of each beam."""

    def points(simulation):
        recording = simulation.recording
        beams = np.arange(recording.n_beams)
        ends = recording.end_points(beams, simulation.truth.T_world_base)
        return ends, recording.scans_of(beams)

    return points


@pytest.fixture(scope="session")
def yard():
    """Simulates a robot that drives round and turns on the spot among pillars."""

    def run(seed=2, people=0, robot=None, **sensors):
        walls = (*box(0, 0, 14, 10), *pillar(0.5, 0.3, 0.6), *pillar(-3, 2.5, 0.2))
        route = ((-4.0, -3.0), (4.0, -3.0), (4.0, 3.0), (-4.0, -2.0))
        crowd = {"people": people, "min_speed": 1.5, "stopping_share": 0.0}
        changes = {"crowd": crowd, "robot": {"speed": 1.5, "turn_rate": 2.0, **(robot or {})}}
        scene = Scene(name="yard", walls=walls, route=route)
        return simulate(override(scene, {**changes, **sensors}), seed)

    return run
