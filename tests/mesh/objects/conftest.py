"""A small room with people, seen by a lidar and a camera, or by two lasers and a camera."""

from pathlib import Path

import numpy as np
import pytest

from stillmap.cli.main import main
from stillmap.sim import Scene, scene_by_name, simulate, write_simulation
from stillmap.sim.options import CameraOptions, CrowdOptions, LidarOptions, RobotOptions
from stillmap.sim.walls import box

QUICK = ("--quiet", "--threads", "1", "--set", "em.max_iterations=1")


@pytest.fixture(scope="session")
def room(tmp_path_factory) -> Path:
    """A recording folder: 20 sweeps of 16 channels, 10 pictures, five people."""
    path = tmp_path_factory.mktemp("recording") / "room"
    scene = Scene(
        "room",
        walls=(*box(0, 0, 8, 6), *box(1.5, 1.5, 0.8, 0.6), *box(-2.0, 1.8, 1.0, 0.4)),
        route=((-2.5, -1.5), (2.5, -1.5), (2.5, 1.5)),
        crowd=CrowdOptions(people=5),
        lidar=LidarOptions(channels=16, columns=180),
        camera=CameraOptions(enabled=True, width=96, height=72, rate=5.0),
        robot=RobotOptions(scans=20, scan_rate=10.0),
    )
    write_simulation(simulate(scene, np.random.default_rng(1)), path)
    return path


@pytest.fixture(scope="session")
def rig(tmp_path_factory) -> Path:
    """A folder of two recordings: a hall with people for 4 s, 16 pictures."""
    path = tmp_path_factory.mktemp("recording") / "rig"
    changes = {
        "rig": {"tilts": True, "period": 2.0},
        "laser": {"beams": 91, "sweep_time": 0.02, "max_range": 8.0},
        "robot": {"scans": 100, "scan_rate": 25.0},
        "crowd": {"people": 40},
        "camera": {"enabled": True, "width": 96, "height": 72, "rate": 4.0},
    }
    write_simulation(simulate(scene_by_name("hall", changes), 5), path)
    return path


@pytest.fixture(scope="session")
def mapped(room, tmp_path_factory):
    """Maps the room with its true poses; gives the result folder."""
    inside = tmp_path_factory.mktemp("mapped")

    def run(name: str, *words: object, source: Path = room) -> Path:
        truth = room / "truth/trajectory.tum"
        arguments = ("map", source, "-o", inside / name, "--poses", truth, *QUICK, *words)
        assert main([str(word) for word in arguments]) == 0
        return inside / name

    return run


@pytest.fixture(scope="session")
def result(mapped) -> Path:
    """What comes of the room."""
    return mapped("result")
