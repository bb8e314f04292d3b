"""A populated corridor, pushed scan by scan."""

import pytest
from live_runs import Run, simulate_sweeps

from stillmap.sim import scene_by_name, simulate


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
