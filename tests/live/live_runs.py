"""Recordings pushed scan by scan."""

from itertools import islice

import numpy as np

from stillmap.live.mapper import LiveMapper
from stillmap.live.replay import iter_beams
from stillmap.sim import scene_by_name, simulate


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
        return poses_of(self.updates)

    @property
    def p_static(self):
        return np.concatenate([update.p_static for update in self.updates])


def answers(recording, scans=None, **settings):
    """What a new mapper answers to the scans of a recording, or the first of them."""
    odometry = recording.T_odom_base
    with LiveMapper({"threads": 1}, **settings) as mapper:
        return [
            mapper.push(beams, None if odometry is None else odometry[t])
            for t, beams in enumerate(islice(iter_beams(recording), scans))
        ]


def poses_of(updates):
    return np.array([update.pose for update in updates])


def simulate_sweeps(scene, scans, seed=3):
    """A recording of a spinning lidar, and its truth."""
    lidar = {"channels": 24, "columns": 600}
    return simulate(scene_by_name(scene, {"lidar": lidar, "robot": {"scans": scans}}), seed)
