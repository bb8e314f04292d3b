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
        self.beams = list(iter_beams(self.recording))
        self.updates = push_all(self.mapper, self.recording)

    @property
    def poses(self):
        return poses_of(self.updates)

    @property
    def p_static(self):
        return np.concatenate([update.p_static for update in self.updates])


def push_all(mapper, recording, scans=None):
    """Push the scans of a recording, or the first of them; the updates."""
    odometry = recording.T_odom_base
    return [
        mapper.push(beams, None if odometry is None else odometry[t])
        for t, beams in enumerate(islice(iter_beams(recording), scans))
    ]


def answers(recording, scans=None, **settings):
    """What a new mapper answers to the scans of a recording, or the first of them."""
    with LiveMapper({"threads": 1}, **settings) as mapper:
        return push_all(mapper, recording, scans)


def poses_of(updates):
    return np.array([update.pose for update in updates])


def simulate_sweeps(scene, scans, seed=3):
    """A recording of a spinning lidar, and its truth."""
    lidar = {"channels": 24, "columns": 600}
    return simulate(scene_by_name(scene, {"lidar": lidar, "robot": {"scans": scans}}), seed)


def distances_to_walls(grid, truth, T_world_map):
    """(n,) m from the occupied cells of a map to the nearest wall."""
    rows, columns = np.nonzero(grid.p_occupied > 0.65)
    at = (np.stack([columns, rows], axis=1) + 0.5) * grid.resolution + grid.origin[:2]
    at = at @ T_world_map[:2, :2].T + T_world_map[:2, 2]
    a, b = truth.walls[:, :2], truth.walls[:, 2:]
    along = np.einsum("nwd,wd->nw", at[:, None] - a, b - a) / ((b - a) ** 2).sum(axis=1)
    off = at[:, None] - a - np.clip(along, 0, 1)[..., None] * (b - a)
    return np.linalg.norm(off, axis=2).min(axis=1)
