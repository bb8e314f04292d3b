"""Fixtures: results of a small hall and a street, to be read by other programs."""

from pathlib import Path

import pytest

from stillmap.cli.main import main
from stillmap.core.recording import Recording
from stillmap.io import stillmap_folder
from stillmap.sim import scene_by_name, simulate, write_simulation


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording folder: a hall with people, 240 scans of two lasers with beam times."""
    path = tmp_path_factory.mktemp("contract") / "recording"
    laser = {"beams": 90, "second_laser": True, "sweep_time": 0.05, "x": 0.2}
    changes = {"robot": {"scans": 240}, "laser": laser, "crowd": {"people": 12}}
    write_simulation(simulate(scene_by_name("hall", changes), 5), path)
    return path


@pytest.fixture(scope="session")
def recording(recorded: Path) -> Recording:
    """That recording as arrays."""
    return stillmap_folder.read(recorded)


@pytest.fixture(scope="session")
def result(recorded: Path) -> Path:
    """Its result folder."""
    out = recorded.parent / "result"
    words = ["map", recorded, "-o", out, "--quiet", "--set", "em.max_iterations=2"]
    assert main([*map(str, words)]) == 0
    return out


@pytest.fixture(scope="session")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording folder in 3D: a street with cars, 40 sweeps with beam times."""
    path = tmp_path_factory.mktemp("contract") / "street"
    lidar = {"channels": 32, "columns": 300}
    scene = scene_by_name("street", {"lidar": lidar, "robot": {"scans": 40}})
    write_simulation(simulate(scene, 3), path)
    return path


@pytest.fixture(scope="session")
def mapped_street(street: Path) -> Path:
    """Its result folder."""
    out = street.parent / "mapped"
    words = ["map", street, "-o", out, "--quiet", "--poses", street / "truth/trajectory.tum"]
    words += ["--no-mesh"]
    assert main([*map(str, words)]) == 0
    return out
