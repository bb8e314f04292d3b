"""Simulated drives, estimates of their poses, and contexts of loop closure."""

from itertools import accumulate

import numpy as np
from rooms import drive

from stillmap.core import se2
from stillmap.results.eval.trajectory import compute_absolute_errors
from stillmap.slam import SlamOptions, local_map, m_step
from stillmap.slam.scan_hits import beams_of_scans, select_beams
from stillmap.slam.types import LoopContext

OPTIONS = SlamOptions()


def silent(*_):
    """Ignores progress."""


def prior(recording):
    """P(static) of beams whose labels are not known yet."""
    return np.full(recording.n_beams, 0.9, np.float32)


def mapped(recording, options=OPTIONS, initial=None):
    """The M-step."""
    return m_step(recording, prior(recording), options, None, 1, silent, initial=initial)


def picked(recording, scans):
    """Some of the scans of a recording, rising."""
    beams = beams_of_scans(recording, scans, recording.n_beams)
    return select_beams(recording, scans, beams, recording.T_odom_base[scans])


def ate(found, truth):
    """RMS m of the poses, aligned to those of a simulation."""
    return compute_absolute_errors(found.poses, truth.T_world_base).rmse


def chained(steps):
    """Poses (T, D+1, D+1) along steps, from the origin."""
    return np.array([*accumulate(steps, np.matmul, initial=np.eye(steps.shape[-1]))])


def loop_context(recording, poses, travelled, keyframes, e=0.0):
    """What loops are searched in; all of it is explained."""
    n = len(poses)
    weights, drift = np.full(recording.n_beams, e, np.float32), np.zeros((n, 3, 3))
    return LoopContext(
        recording, weights, poses, travelled, np.ones(n), keyframes, 0.05, 1.0, 6.0, drift
    )


def driven(walls, route, laser, speed=1.0):
    """A recording of a robot that drives among walls, with true poses."""
    simulation = drive(0, walls, route, laser=laser, robot={"speed": speed})
    truth = simulation.truth.T_world_base
    poses = se2.inverse(truth[0]) @ truth
    travelled = local_map.travelled_distance(poses)
    keyframes = local_map.select_keyframes(poses, 1.0, 0.5)
    return loop_context(simulation.recording, poses, travelled, keyframes, 0.9)
