"""A small populated room that every test of the loop can afford, and what they run it with."""

import functools

import numpy as np
import pytest

from stillmap.sim import Scene, simulate
from stillmap.sim.options import CrowdOptions, LaserOptions, RobotOptions
from stillmap.sim.walls import box


@functools.cache
def _room(scans, max_range):
    scene = Scene(
        "room",
        walls=(*box(0, 0, 9, 7), *box(1.5, 1.6, 0.9, 0.6), *box(-2.6, 1.9, 1.0, 0.4)),
        route=((-2.5, -1.5), (2.5, -1.5), (2.5, 1.5)),
        crowd=CrowdOptions(people=3),
        laser=LaserOptions(beams=120, range_noise=0.01, max_range=max_range),
        robot=RobotOptions(scans=scans),
    )
    return simulate(scene, np.random.default_rng(4))


@pytest.fixture(scope="session")
def room():
    """60 scans of 120 beams, three people, some beams at maximum range."""
    simulation = _room(60, 7.0)
    assert 0 < (~simulation.recording.hit).sum() < 0.2 * simulation.recording.n_beams
    assert (simulation.truth.mover >= 0).sum() > 100
    return simulation


@pytest.fixture(scope="session")
def short():
    """The same with 6 scans."""
    return _room(6, 7.0)
