"""Robots that drive among walls, where loops can be looked for."""

import numpy as np

from stillmap import se2
from stillmap.simulation import RobotOptions, Scene, simulate
from stillmap.simulation.scene import CrowdOptions, OdometryOptions
from stillmap.slam import SlamOptions, keyframes
from stillmap.slam.loops import Track

OPTIONS = SlamOptions()


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
    return Track(
        simulation.recording,
        np.full(simulation.recording.n_beams, 0.9, np.float32),
        poses,
        keyframes.travel(poses),
        np.ones(len(poses)),
        keyframes.chosen(poses, 1.0, 0.5),
        0.05,
        OPTIONS.registration,
        OPTIONS.surface,
        OPTIONS.loops,
    )
