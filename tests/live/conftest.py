"""A populated corridor, pushed scan by scan."""

import sys
from pathlib import Path

import numpy as np
import pytest

from stillmap.live.mapper import LiveMapper
from stillmap.live.replay import iter_beams
from stillmap.sim import scene_by_name, simulate

sys.path.insert(0, str(Path(__file__).resolve().parent))  # for what the tests share


class Run:
    """A recording, and what the live mapper answered to it."""

    def __init__(self, simulation, threads=1):
        self.recording, self.truth = simulation.recording, simulation.truth
        self.mapper = LiveMapper({"threads": threads})
        odometry = self.recording.T_odom_base
        self.beams = list(iter_beams(self.recording))
        self.updates = [
            self.mapper.push(beams, None if odometry is None else odometry[t])
            for t, beams in enumerate(self.beams)
        ]

    @property
    def poses(self):
        return np.array([update.pose for update in self.updates])

    @property
    def p_static(self):
        return np.concatenate([update.p_static for update in self.updates])


@pytest.fixture(scope="session")
def corridor():
    """There and back through a corridor with people: the way back closes loops."""
    run = Run(simulate(scene_by_name("corridor", {"robot": {"scans": 400}}), 3))
    yield run
    run.mapper.close()


@pytest.fixture(scope="session")
def sweeps():
    """A spinning lidar of 24 channels in a hall with people."""
    run = Run(simulate_sweeps("hall", 100))
    yield run
    run.mapper.close()


def simulate_sweeps(scene, scans, seed=3):
    """A recording of a spinning lidar, and its truth."""
    lidar = {"channels": 24, "columns": 600}
    return simulate(scene_by_name(scene, {"lidar": lidar, "robot": {"scans": scans}}), seed)
