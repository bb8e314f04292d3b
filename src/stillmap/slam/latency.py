"""Latency of odometry: the one at which its steps are the likeliest, given the poses of scans."""

import dataclasses
from typing import NamedTuple

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Float
from stillmap.core.recording import Recording
from stillmap.slam.hand_eye import correct_odometry
from stillmap.slam.odometry_2d import register_scans
from stillmap.slam.options import SlamOptions
from stillmap.slam.scan_hits import select_beams
from stillmap.slam.trajectory_cost import OdometryCost

MAX_LATENCY = 3.0  # s, early or late, that is tried
_STEPS = 0.25, 0.05, 0.01  # s, of one grid after the other around the best, then a parabola
# scans that are matched in each round, at most: those of the stretch with the most rotation
_MAX_SCANS = (300, *[1000] * 5)
_NEGLIGIBLE = 0.05  # s, half of what would be corrected
_MAX_TRAVEL = 25.0  # m after which they leave the local map


class LatencyFit(NamedTuple):
    """The latency of odometry.

    Attributes:
        latency: s; negative: early.
        std: s; infinite where the recording does not show it.
        gain: nats by which the steps are more likely than without latency.
    """

    latency: float = 0.0
    std: float = np.inf
    gain: float = 0.0


def fit_latency(recording: Recording, p_static: float, options: SlamOptions) -> LatencyFit:
    """The latency that minimises the cost of the steps of matched scans, given odometry.

    Odometry as recorded draws matches, and the fit, towards zero: scans are matched again.

    Args:
        recording: 2D, with odometry.
        p_static: of every beam.
        options: see SlamOptions.
    """
    fit = LatencyFit()
    for max_scans in _MAX_SCANS:
        scans = _select_scans(recording, max_scans)
        e = np.full(scans.n_beams, p_static, np.float32)
        shifted = shift_odometry(scans, fit.latency)
        matched = register_scans(shifted, e, options, lambda *_: None, _MAX_TRAVEL)
        before, fit = fit, _fit_to_poses(scans, matched.poses, options)
        if abs(fit.latency) <= _NEGLIGIBLE or abs(fit.latency - before.latency) <= _STEPS[-1]:
            break
    return fit


def _fit_to_poses(recording: Recording, poses: Float, options: SlamOptions) -> LatencyFit:
    """The same given the poses (T, 3, 3) of all scans."""

    def cost(latency: float) -> float:
        shifted = shift_odometry(recording, latency)
        return OdometryCost(shifted, poses, options.odometry)(poses, 1, len(poses))

    best, width = 0.0, MAX_LATENCY
    for step in _STEPS:
        tried = best + step * np.arange(-round(width / step), round(width / step) + 1)
        best, width = min(tried.tolist(), key=cost), step
    least, before, after = cost(best), cost(best - width), cost(best + width)
    vertex = best + 0.5 * width * (before - after) / max(before + after - 2.0 * least, 1e-9)
    h = _STEPS[1]
    curvature = (cost(best - h) + cost(best + h) - 2.0 * least) / h**2
    if abs(best) >= MAX_LATENCY or curvature <= 0.0:
        return LatencyFit()
    return LatencyFit(vertex, curvature**-0.5, cost(0.0) - least)


def shift_odometry(recording: Recording, latency: float) -> Recording:
    """The recording with odometry corrected that is so many s late."""
    if latency == 0.0:
        return recording
    assert recording.T_odom_base is not None
    seconds = 1e-9 * (recording.stamp_ns - recording.stamp_ns[0])
    odometry = correct_odometry(
        seconds, recording.T_odom_base, scale=1.0, rotation_gain=1.0, latency=latency
    )
    return dataclasses.replace(recording, T_odom_base=odometry)


def _select_scans(recording: Recording, max_scans: int) -> Recording:
    """The stretch in which odometry turns most, of the first laser: others may be mounted amiss."""
    assert recording.T_odom_base is not None
    scans = np.flatnonzero(recording.sensor == recording.sensor[0])
    turns = np.abs(se2.parameters(se2.increments(recording.T_odom_base[scans]))[:, 2])
    turned, n = np.append(0.0, turns.cumsum()), min(max_scans, len(scans))
    first = int(np.argmax(turned[n - 1 :] - turned[: len(turned) - n + 1]))
    scans = scans[first : first + n]
    beams = [np.arange(*recording.offset[t : t + 2]) for t in scans.tolist()]
    return select_beams(recording, scans, beams, recording.T_odom_base[scans])
