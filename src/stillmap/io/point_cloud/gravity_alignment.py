"""Recorded poses turned so that z is up, where their world lies anyhow.

Who holds a camera holds it upright on the whole: the mean of its upward axes is up within some
ten degrees. The surfaces that face nearest that way are floors, tables and shelves, and the
largest of these planes is level.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.recording import Recording

Float = NDArray[np.float64]

_SCANS = 60  # that are looked at
_ACROSS = 32  # patches across a picture, each of which has a direction
_UPRIGHT = 0.3  # length of the mean of upward axes; where it is less, they point anywhere
_NEAR = np.tan(np.radians(40.0))  # floors face so near to the mean
_BIN = 0.035  # of directions, two degrees
_FACING = np.cos(np.radians(5.0))  # surfaces of one direction do within this
_SHARE = 0.05  # of all surfaces that face there, at least
_LAYER = 0.05  # m, of heights
_LARGE = 0.2  # m, standard deviation along the shorter side of a plane that tells a direction
_ROUNDS = 5


class _Surfaces(NamedTuple):
    """(n, 3) points of surfaces, and which way each faces, length one; in the recorded world."""

    points: Float
    normals: Float


def align_to_gravity(recording: Recording) -> Recording:
    """The recording, its recorded poses turned about their origin so that z is up.

    `source["levelled"]` says by how much, and by what it was found.

    Args:
        recording: of scans that are grids, see `source["sensors"]`.
    """
    T = recording.T_recorded_base
    if T is None:
        return recording
    mean = T[:, :3, 2].mean(axis=0)
    length = float(np.linalg.norm(mean))
    if length < _UPRIGHT:
        return _noted(recording, {"by": "nothing: the cameras point anywhere"})
    up, by = _refined(_surfaces(recording, T), mean / length)
    turn = np.eye(4)
    turn[:3, :3] = _turn(up)
    angle = float(np.degrees(np.arccos(np.clip(up[2], -1.0, 1.0))))
    noted = {"by": by, "turned_deg": round(angle, 2), "up": [round(float(v), 6) for v in up]}
    return _noted(replace(recording, T_recorded_base=turn @ T), noted)


def _noted(recording: Recording, what: dict[str, Any]) -> Recording:
    return replace(recording, source={**recording.source, "levelled": what})


def _surfaces(recording: Recording, T: Float) -> _Surfaces:
    rows, columns = recording.source["sensors"][0]["grid"]
    apart = max(1, columns // _ACROSS)
    points, normals = [np.empty((0, 3))], [np.empty((0, 3))]
    scans = np.unique(np.linspace(0, recording.n_scans - 1, _SCANS).astype(np.intp))
    for scan in recording.iter_scans(scans.tolist()):
        grid = recording.points[recording.beams_of(scan)].reshape(rows, columns, 3)
        hit = recording.hit[recording.beams_of(scan)].reshape(rows, columns)
        corners = np.where(hit[..., None], grid, np.nan)[::apart, ::apart].astype(np.float64)
        here, aside, below = corners[:-1, :-1], corners[:-1, 1:], corners[1:, :-1]
        normal = np.cross(below - here, aside - here).reshape(-1, 3)
        length = np.linalg.norm(normal, axis=1)
        # over an edge of something, a patch is large
        reach = np.linalg.norm(here.reshape(-1, 3), axis=1)
        good = (length > 0.0) & (length < (0.2 * reach) ** 2)
        placed = here.reshape(-1, 3)[good] @ T[scan, :3, :3].T + T[scan, :3, 3]
        points.append(placed)
        normals.append((normal[good] / length[good, None]) @ T[scan, :3, :3].T)
    return _Surfaces(np.concatenate(points), np.concatenate(normals))


def _refined(surfaces: _Surfaces, up: Float) -> tuple[Float, str]:
    """(3,) which way is up, and by what that was found."""
    by_cameras = up, "cameras"
    facing = surfaces.normals @ up
    ahead = facing > 0.0
    if not ahead.any():
        return by_cameras
    # directions in the plane that touches the sphere at `up`
    R = _turn(up)
    turned = surfaces.normals[ahead] @ R.T
    flat = turned[:, :2] / turned[:, 2:]
    near = (np.abs(flat) < _NEAR).all(axis=1)
    if not near.any():
        return by_cameras
    edges = np.arange(-_NEAR, _NEAR + _BIN, _BIN)
    counts = np.histogram2d(flat[near, 0], flat[near, 1], bins=[edges, edges])[0]
    at = np.unravel_index(counts.argmax(), counts.shape)
    mode = R.T @ np.array([edges[at[0]] + 0.5 * _BIN, edges[at[1]] + 0.5 * _BIN, 1.0])
    mode /= np.linalg.norm(mode)
    for _ in range(_ROUNDS):
        its = surfaces.normals @ mode > _FACING
        if its.sum() < _SHARE * len(surfaces.normals):
            return by_cameras
        mode = surfaces.normals[its].mean(axis=0)
        mode /= np.linalg.norm(mode)
    return _of_plane(surfaces, mode)


def _of_plane(surfaces: _Surfaces, up: Float) -> tuple[Float, str]:
    """The direction of the plane, across `up`, on which most points lie; `up` if it is small."""
    for _ in range(_ROUNDS):
        points = surfaces.points[surfaces.normals @ up > _FACING]
        height = points @ up
        bins = np.floor((height - height.min()) / _LAYER).astype(np.intp)
        level = height.min() + (np.bincount(bins).argmax() + 0.5) * _LAYER
        on = points[np.abs(height - level) < _LAYER]
        values, axes = np.linalg.eigh(np.cov(on.T)) if len(on) > 3 else (np.zeros(3), np.eye(3))
        if not values[1] > _LARGE**2:
            return up, "surfaces"
        normal = axes[:, 0] * np.sign(axes[:, 0] @ up)
        if not normal @ up > _FACING:
            return up, "surfaces"
        up = normal
    return up, "plane"


def _turn(up: Float) -> Float:
    """(3, 3) the least turn that makes a direction the z axis."""
    z = np.array([0.0, 0.0, 1.0])
    axis, cosine = np.cross(up, z), float(up @ z)
    if cosine < -1.0 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    x, y, w = axis
    W = np.array([[0.0, -w, y], [w, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + W + W @ W / (1.0 + cosine))
