"""Sweeps of one rigid thing laid over each other: where its track says it is, it is not quite.

A track follows the middle of what is seen, and of a car that passes by that is first its front and
then its rear. Sweep by sweep it is registered against what is known of it so far, point to plane,
each beam weighted by its P(dynamic), and held by the track where its shape says nothing.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Float = NDArray[np.float64]

_ROUNDS = 25
_REACHES = (1.0, 0.5, 0.25)  # m, within which points are of the same place, round by round less
_CELL = 0.04  # m, in which one point is enough
_TRACK = (0.4, 0.15, 0.06)  # m ahead, m aside, rad: by how much a track may be off
_SIGMA = 0.03  # m, by how much points lie off a surface
_ALONG = 0.1  # m, by how much the nearest point of a surface lies beside
_POINTS = 2000  # of a sweep, at most: more do not make it better
_FEWEST = 20  # points of a sweep that say where it is
_SAME_SIDE = 0.5  # cosine between normals of one surface
_ASKED = 12  # sweeps of which it is asked how well they lie over the others
_MOST = 60  # sweeps that are laid over each other at most


class Sweep(NamedTuple):
    """What was seen of a thing at one time, in its own frame as its track has it.

    Attributes:
        points: (n, 3) metres.
        normals: (n, 3) of length one, towards the sensor.
        weights: (n,) how probably it is of the thing.
    """

    points: Float
    normals: Float
    weights: Float


def aligned(sweeps: Sequence[Sweep]) -> Float:
    """(S, 3) metres ahead and to the left, rad to the left, by which each sweep has to be moved.

    From the sweep with most points to both sides, each against all before; then once more each
    against all others.
    """
    out = np.zeros((len(sweeps), 3))
    size = [len(one.points) for one in sweeps]
    if not size or max(size) < _FEWEST:
        return out
    best = int(np.argmax(size))
    order = [*range(best + 1, len(sweeps)), *range(best - 1, -1, -1)]
    done = [best]
    for k in order:
        # what the nearest one that is done was off by is a good guess
        beside = min(done, key=lambda other: (abs(other - k), other))
        out[k] = _registered(sweeps[k], _model(sweeps, out, done), out[beside], out[beside])
        done.append(k)
    for k in range(len(sweeps)):
        if k != best:
            others = [other for other in done if other != k]
            out[k] = _registered(sweeps[k], _model(sweeps, out, others), out[k], out[k])
    return out


def spread(sweeps: Sequence[Sweep], offsets: Float) -> float:
    """Metres, by how much sweeps lie off each other across their surface: 3 of 4 places are less.

    0 where they have nothing in common.
    """
    asked = np.unique(np.linspace(0, len(sweeps) - 1, min(len(sweeps), _ASKED)).astype(np.intp))
    off = [np.zeros(0)]
    for k in asked.tolist():
        others = [other for other in range(len(sweeps)) if other != k]
        if not others or not len(sweeps[k].points):
            continue
        model = _model(sweeps, offsets, others)
        every = max(1, len(sweeps[k].points) // _POINTS)
        at = moved(sweeps[k].points[::every], offsets[k])
        facing = moved(sweeps[k].normals[::every], np.array([0.0, 0.0, offsets[k, 2]]))
        away, nearest = map(np.asarray, cKDTree(model.points).query(at))
        near = away <= _REACHES[1]
        near &= (facing * model.normals[nearest]).sum(axis=1) > _SAME_SIDE
        at, nearest = at[near], nearest[near]
        off.append(np.abs(((at - model.points[nearest]) * model.normals[nearest]).sum(axis=1)))
    all_off = np.concatenate(off)
    return float(np.quantile(all_off, 0.75)) if len(all_off) else 0.0


def moved(points: Float, offset: Float) -> Float:
    """(n, 3) points, turned and moved in the plane by (3,)."""
    c, s = np.cos(offset[2]), np.sin(offset[2])
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(points @ R.T + [offset[0], offset[1], 0.0])


def _model(sweeps: Sequence[Sweep], offsets: Float, of: Sequence[int]) -> Sweep:
    """What several sweeps know together, one point in each cell; of many sweeps every n-th."""
    some = sorted(of)[:: max(1, -(-len(of) // _MOST))]
    turned = [np.array([0.0, 0.0, offsets[k, 2]]) for k in some]
    points = np.concatenate([moved(sweeps[k].points, offsets[k]) for k in some])
    normals = np.concatenate(
        [moved(sweeps[k].normals, turn) for k, turn in zip(some, turned, strict=True)]
    )
    weights = np.concatenate([sweeps[k].weights for k in some])
    cells = np.floor(points / _CELL).astype(np.int64)
    first = np.unique(cells, axis=0, return_index=True)[1]
    return Sweep(points[first], normals[first], weights[first])


def _registered(sweep: Sweep, model: Sweep, start: Float, track: Float) -> Float:
    """The offset (3,) of a sweep against what is known, from `start`, held to `track`."""
    if len(sweep.points) < _FEWEST or len(model.points) < _FEWEST:
        return start
    every = max(1, len(sweep.points) // _POINTS)
    points, normals, weights = (array[::every] for array in sweep)
    tree, offset = cKDTree(model.points), start.copy()
    hold = np.diag(1.0 / np.square(_TRACK))
    for k in range(_ROUNDS):
        reach = _REACHES[min(k // 3, len(_REACHES) - 1)]
        at = moved(points, offset)
        away, nearest = map(np.asarray, tree.query(at, distance_upper_bound=reach))
        near = np.flatnonzero(np.isfinite(away))
        facing = moved(normals[near], np.array([0.0, 0.0, offset[2]]))
        same = (facing * model.normals[nearest[near]]).sum(axis=1) > _SAME_SIDE
        near = near[same]
        if len(near) < _FEWEST:
            return offset
        n, q = model.normals[nearest[near]], model.points[nearest[near]]
        x, y = (at[near, :2] - offset[:2]).T
        # across the surface, and along it, where only the ends of a side tell anything
        along = np.stack([-n[:, 1], n[:, 0], np.zeros(len(n))], axis=1)
        H, g = hold, hold @ (offset - track)
        for d, sigma in ((n, _SIGMA), (along, _ALONG)):
            residual = ((at[near] - q) * d).sum(axis=1)
            J = np.stack([d[:, 0], d[:, 1], d[:, 1] * x - d[:, 0] * y], axis=1)
            w = weights[near] / (1.0 + (residual / (3.0 * sigma)) ** 2) ** 2 / sigma**2
            # neighbours are off together: all points together count as a hundred
            w *= min(1.0, 100.0 / len(near))
            H, g = H + J.T @ (w[:, None] * J), g + J.T @ (w * residual)
        step = -np.linalg.solve(H, g)
        offset = offset + step
        if np.abs(step).max() < 1e-4 and reach == _REACHES[-1]:
            break
    return offset
