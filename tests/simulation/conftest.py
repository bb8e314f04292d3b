"""Runs of populated worlds, shared by the tests."""

import functools

import pytest

from stillmap.simulation import Simulation, scene_by_name, simulate


@functools.cache
def _run(name: str) -> Simulation:
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
