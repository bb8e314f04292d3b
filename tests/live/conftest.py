"""A populated corridor, pushed scan by scan."""

import sys
from pathlib import Path

import pytest

from stillmap.sim import scene_by_name, simulate

sys.path.insert(0, str(Path(__file__).resolve().parent))  # for what the tests share

from live_runs import Run, simulate_sweeps


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
