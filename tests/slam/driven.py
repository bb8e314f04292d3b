"""Simulated drives as contexts of loop closure."""

import numpy as np

from stillmap.core import se2
from stillmap.sim import RobotOptions, Scene, simulate
from stillmap.sim.options import CrowdOptions, OdometryOptions
from stillmap.slam import local_map
from stillmap.slam.types import LoopContext


def driven(walls, route, laser, speed=1.0):
    """A recording of a robot that drives among walls, with true poses."""
    scene = Scene(
        "across",
        walls=walls,
        route=route,
        crowd=CrowdOptions(people=0),
        laser=laser,
        robot=RobotOptions(speed=speed),
        odometry=OdometryOptions(),
    )
    simulation = simulate(scene, 0)
    truth = simulation.truth.T_world_base
    poses = se2.inverse(truth[0]) @ truth
    return LoopContext(
        simulation.recording,
        np.full(simulation.recording.n_beams, 0.9, np.float32),
        poses,
        local_map.travelled_distance(poses),
        np.ones(len(poses)),
        local_map.select_keyframes(poses, 1.0, 0.5),
        0.05,
        1.0,
        6.0,
        np.zeros((len(poses), 3, 3)),
    )
