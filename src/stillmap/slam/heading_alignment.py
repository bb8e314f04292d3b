"""Headings of a pose graph, aligned by the directions of walls.

Loops say how far the heading has drifted where they close, and nothing about an open route. The
directions of all walls of the recording, modulo a quarter turn, measure the heading of every
keyframe. Directions and headings are estimated in turn.
"""

import dataclasses
import functools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.array_types import Float, Float32
from stillmap.core.recording import Recording
from stillmap.slam.pose_graph import Constraint, HeadingMeasurement, PoseGraph, optimize_headings
from stillmap.slam.scan_hits import Scan, select_hits

_BINS = 360  # of a quarter turn
_BIN = 0.5 * np.pi / _BINS  # rad, 0.25 degrees
_UNRELATED = 0.3  # share of normals of any direction, at least
_WINDOW = 12  # bins to either side: 3 degrees; heading drifts less before it is corrected


class HeadingOffset(NamedTuple):
    """Correction of a heading, rad, and its variance, rad2."""

    value: float
    variance: float


class Directions:
    """Histogram of the directions of normals, modulo a quarter turn.

    Attributes:
        weights: (360,) of the bins.
    """

    def __init__(self, weights: Float | None = None) -> None:
        self.weights = np.zeros(_BINS) if weights is None else weights

    @classmethod
    def of_scan(cls, scan: Scan, heading: float) -> "Directions":
        """Normals of the flat surfaces of a scan at a heading in rad, weighted by e."""
        weights = scan.weights * (1.0 - scan.isotropy)
        flat = (weights > 0.0) & ((scan.normals[:, 0] != 0.0) | (scan.normals[:, 1] != 0.0))
        normals = scan.normals[flat].astype(np.float64)
        bins = (np.arctan2(normals[:, 1], normals[:, 0]) + heading) / _BIN
        low = np.floor(bins).astype(np.int64)
        share, weight = bins - low, weights[flat]
        out = np.bincount(low % _BINS, (1.0 - share) * weight, _BINS)
        out += np.bincount((low + 1) % _BINS, share * weight, _BINS)
        return cls(out.astype(np.float64))

    def rotate(self, angle: float) -> "Directions":
        """The same, rotated by `angle` rad."""
        bins = angle / _BIN
        whole = int(np.floor(bins))
        share = bins - whole
        rotated = np.roll(self.weights, whole)
        return Directions((1.0 - share) * rotated + share * np.roll(rotated, 1))


class DirectionDensity:
    """Likelihood of the direction of a normal, given those of a building.

    Args:
        seen: directions of the building.
        kernel: standard deviation of normals about the direction of their wall, rad.
    """

    def __init__(self, seen: Directions, kernel: float) -> None:
        total = seen.weights.sum()
        smoothed = np.fft.rfft(seen.weights / total) * _transform_kernel(kernel)
        density = np.fft.irfft(smoothed, _BINS)
        log_ratio = np.log((1.0 - _UNRELATED) * _BINS * density.clip(0.0) + _UNRELATED)
        self._around = np.concatenate([log_ratio[-_WINDOW:], log_ratio, log_ratio[:_WINDOW]])

    def measure(self, scan: Directions, evidence: float) -> HeadingOffset | None:
        """The offset within 3 degrees that maximizes the likelihood of the normals of a scan.

        Args:
            scan: its directions at the heading so far.
            evidence: of a normal, as a share of that of an independent one.

        Returns:
            The offset; None if the likelihood has no maximum in the window, or a flat one.
        """
        gain = evidence * np.correlate(self._around, scan.weights)
        best = int(gain.argmax())
        if best in (0, 2 * _WINDOW):
            return None
        before, here, after = gain[best - 1 : best + 2]
        curvature = 2.0 * here - before - after
        if curvature <= _WINDOW**-2:
            return None  # less certain than the window is wide
        offset = best - _WINDOW + 0.5 * (after - before) / curvature
        return HeadingOffset(float(offset * _BIN), float(_BIN**2 / curvature))


@functools.cache
def _transform_kernel(std: float) -> NDArray[np.complex128]:
    """Fourier transform of a Gaussian of `std` rad on the bins."""
    away = np.minimum(np.arange(_BINS), _BINS - np.arange(_BINS)) * _BIN
    kernel = np.exp(-0.5 * (away / std) ** 2)
    return np.fft.rfft(kernel / kernel.sum())


# normals along 3 m of a surface, whose noise is a tenth of that of the normals of registration;
# only straight surfaces have one
_NORMALS = {"radius": 1.5, "max_gap": 1.0, "flat_below": 0.003, "round_from": 0.01}
_KERNEL = np.radians(0.5)  # std of these normals about the direction of a wall
_EVIDENCE = 0.03  # of each: those within 3 m share their end points
_MIN_TRAVEL = 8.0  # m from which on directions are known
_MIN_STD = np.radians(0.3)  # of a building's walls about its directions
_CORRELATION = 4.0  # m along which walls deviate alike from the directions of the building
_UPDATES = 2  # of directions and headings in turn; more draw walls of many directions together
# the chain's covariance is that of windows in which loops are searched, and scan matching drifts
# less in heading: its std is this share of the chain's where the local map measures the heading of
# a scan to _MATCHING_STD rad, and proportional to the variance of that measurement
_DRIFT_SHARE, _MATCHING_STD, _MAX_DRIFT_SHARE = 0.2, 0.004, 0.5
_BREAK_VARIANCE = 1.0  # rad2, from which on a step is one across a break: it stays unconstrained


def align_headings(
    recording: Recording, e: Float32, graph: PoseGraph, covariance: Float
) -> PoseGraph:
    """The graph with keyframes whose headings agree with the directions of the walls.

    Where the walls have directions of all kinds it is hardly changed. Steps of the chain change
    with the poses.

    Args:
        recording: 2D.
        e: (M,) P(static) of every beam.
        graph: optimized.
        covariance: (T, 3, 3) of x, y, heading of the scans against the local map.
    """
    x = se2.parameters(graph.poses)
    steps = np.hypot(*np.diff(x[:, :2], axis=0).T).clip(0.0, 1.0)
    if steps.sum() < _MIN_TRAVEL:
        return graph
    metres = np.append(steps, steps[-1])
    scans = recording.iter_scans(graph.keyframes.tolist(), e)
    views = [Directions.of_scan(select_hits(recording, e, t, _NORMALS), 0.0) for t in scans]
    shares = _drift_shares(covariance[graph.keyframes])
    constraints = [_keep_error(one, graph.poses, shares) for one in graph.constraints]
    poses = graph.poses
    for _ in range(_UPDATES):
        before = se2.parameters(poses)[:, 2]
        headings = _measure_headings(views, before, metres)
        if not headings:
            break
        poses = optimize_headings(poses, constraints, headings)
    turned = [_turn_step(one, graph.poses, poses) for one in graph.constraints]
    return PoseGraph(graph.keyframes, poses, turned)


def _is_step(constraint: Constraint) -> bool:
    """True for an odometry constraint between successive keyframes, unless across a break."""
    successive = constraint.second == constraint.first + 1
    return successive and bool(constraint.covariance[2, 2] < _BREAK_VARIANCE)


def _turn_step(constraint: Constraint, before: Float, after: Float) -> Constraint:
    """The step with the change of the poses, so that the graph solved again has these poses."""
    if not _is_step(constraint):
        return constraint
    k = [constraint.first, constraint.second]
    (i, j), (to_i, to_j) = before[k], after[k]
    change = se2.inverse(se2.inverse(i) @ j) @ se2.inverse(to_i) @ to_j
    return dataclasses.replace(constraint, T=se2.normalize(constraint.T @ change))


def _drift_shares(covariance: Float) -> Float:
    """(K,) std of the heading's drift up to keyframes, as a share of that of the chain."""
    relative = covariance[:, 2, 2] / _MATCHING_STD**2
    return np.minimum(_DRIFT_SHARE * relative, _MAX_DRIFT_SHARE)


def _keep_error(constraint: Constraint, poses: Float, shares: Float) -> Constraint:
    """The constraint as the optimized poses have it, so that nothing but headings changes them.

    Args:
        shares: (K,) of the std of a step's heading, by its second keyframe.
    """
    T = se2.inverse(poses[constraint.first]) @ poses[constraint.second]
    covariance = constraint.covariance
    if _is_step(constraint):
        scale = np.array([1.0, 1.0, shares[constraint.second]])
        covariance = scale[:, None] * covariance * scale
    return dataclasses.replace(constraint, T=T, covariance=covariance)


def _measure_headings(
    views: list[Directions], headings: Float, metres: Float
) -> list[HeadingMeasurement]:
    """Headings of keyframes that agree with the directions of all of them.

    Their noise is learned: how far the keyframes are off the common directions, and along some
    metres all in the same way.

    Args:
        views: (K,) directions in the frames of the keyframes.
        headings: (K,) rad, so far.
        metres: (K,) of travel that a keyframe stands for, at most 1.
    """
    rotated = [view.rotate(heading) for view, heading in zip(views, headings, strict=True)]
    seen = Directions(sum(m * one.weights for m, one in zip(metres, rotated, strict=True)))
    if not seen.weights.any():
        return []
    density = DirectionDensity(seen, _KERNEL)
    offsets = [(k, density.measure(one, _EVIDENCE)) for k, one in enumerate(rotated)]
    measured = [(k, offset) for k, offset in offsets if offset is not None]
    spread = float(np.mean([offset.value**2 for _, offset in measured])) if measured else 0.0
    learned = max(_CORRELATION * spread, _MIN_STD**2)
    return [
        HeadingMeasurement(k, float(headings[k] + offset.value), max(offset.variance, learned))
        for k, offset in measured
    ]
