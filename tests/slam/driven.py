"""Simulated drives as contexts of loop closure."""

import numpy as np
from rooms import drive

from stillmap.core import se2
from stillmap.slam import local_map
from stillmap.slam.types import LoopContext


def driven(walls, route, laser, speed=1.0):
    """A recording of a robot that drives among walls, with true poses."""
    simulation = drive(0, walls, route, laser=laser, robot={"speed": speed})
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
