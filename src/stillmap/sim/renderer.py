"""Rendering: the surface on each pixel's ray, among faces, solids, ground and ceiling.

A surface lies within a rectangle of pixels. Surfaces are rendered from the nearest on, so that
occluded ones cost little.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.sim import ray_casting
from stillmap.sim.geometry import Faces, Float, Ground, Solids
from stillmap.sim.truth_surfaces import StaticSurfaces

STATIC, NOTHING = -1, -2

_NEAR = 0.05  # m, near plane
_EDGES = np.array(
    [(0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (0, 4), (1, 5), (2, 6), (3, 7)]
)
_EDGES_OF_FACE = np.array([(0, 1), (1, 3), (3, 2), (2, 0)])


class Lens(NamedTuple):
    """Pixel rays of a camera.

    Attributes:
        direction: (3, h, w) unit vectors, in the camera frame.
        K: (3, 3) pinhole matrix.
        bends: pixels, maximum distortion.
    """

    direction: Float
    K: Float
    bends: float


class RenderedImage(NamedTuple):
    """The surface at each pixel (h, w).

    Attributes:
        range: metres along its ray; inf: nothing.
        part: int32, number of the moving solid, STATIC or NOTHING.
    """

    range: Float
    part: NDArray[np.int32]


class _Candidate(NamedTuple):
    """A surface that may be visible: face k, or solid k of a group, and its window of pixels."""

    near: float
    group: int
    k: int
    rows: slice
    columns: slice


def render(
    lens: Lens, T_world_camera: Float, static: StaticSurfaces, moving: Solids
) -> RenderedImage:
    """Render the nearest surface at each pixel.

    Args:
        lens: the pixel rays.
        T_world_camera: (4, 4).
        static: the static surfaces.
        moving: moving solids at one time; those without a mover are static.
    """
    faces, ground, groups = static.faces, static.ground, (static.solids, moving)
    R, at = T_world_camera[:3, :3], T_world_camera[:3, 3]
    direction = np.einsum("ij,jhw->ihw", R, lens.direction)
    origin = np.ascontiguousarray(at[:, None, None])
    range = ray_casting.intersect_ground(origin, direction, ground, static.ceiling)
    part = np.where(np.isinf(range), np.int32(NOTHING), np.int32(STATIC))
    things = [*_visible_faces(lens, T_world_camera, faces, ground)]
    for number, group in enumerate(groups):
        things += _visible_solids(lens, T_world_camera, group, number)
    for near, number, k, rows, columns in sorted(things, key=lambda one: one.near):
        before = range[rows, columns]
        if before.max(initial=0.0) <= near:
            continue
        along = direction[:, rows, columns]
        if number < 0:
            t = ray_casting.intersect_face(origin, along, faces.ends[k], faces.z[k], ground)
            what = STATIC
        else:
            group = groups[number]
            t = ray_casting.intersect_solid(origin, along, group, k, group.pose[:1, k])
            what = k if number and group.mover[k] >= 0 else STATIC
        nearer = t < before
        before[nearer] = t[nearer]
        part[rows, columns][nearer] = what
    return RenderedImage(range, part)


def _visible_faces(
    lens: Lens, T_world_camera: Float, faces: Faces, ground: Ground
) -> Iterator[_Candidate]:
    if not len(faces.ends):
        return
    x0, y0, x1, y1 = faces.ends.T
    sag = faces.sag(ground)
    low, high = faces.z[:, 0] - sag, faces.z[:, 1] + sag
    start, end = ground.level(x0, y0), ground.level(x1, y1)
    corners = np.stack(
        [
            np.stack([x, y, level + z], axis=-1)
            for x, y, level in ((x0, y0, start), (x1, y1, end))
            for z in (low, high)
        ],
        axis=1,
    )
    near = faces.distance(*T_world_camera[:2, 3])
    yield from _windows(lens, T_world_camera, corners, _EDGES_OF_FACE, near, -1)


def _visible_solids(
    lens: Lens, T_world_camera: Float, solids: Solids, number: int
) -> Iterator[_Candidate]:
    if not len(solids.form):
        return
    x, y, heading, foot = np.moveaxis(solids.pose[0], -1, 0)
    (a, b), (z0, z1) = solids.half.T, solids.z.T
    c, s = np.cos(heading), np.sin(heading)
    corners = np.stack(
        [
            np.stack([x + c * u * a - s * v * b, y + s * u * a + c * v * b, foot + z], axis=-1)
            for u in (-1, 1)
            for v in (-1, 1)
            for z in (z0, z1)
        ],
        axis=1,
    )
    cx, cy, _ = T_world_camera[:3, 3]
    near = np.hypot(x - cx, y - cy) - solids.radius
    yield from _windows(lens, T_world_camera, corners, _EDGES, near, number)


def _windows(
    lens: Lens,
    T_world_camera: Float,
    corners: Float,
    edges: NDArray[np.int64],
    near: Float,
    number: int,
) -> Iterator[_Candidate]:
    """The windows of pixels of convex shapes that lie within the image.

    Args:
        lens, T_world_camera: the camera.
        corners: (P, C, 3) metres, in the world; NaN of absent shapes.
        edges: (E, 2) connected corners.
        near: (P,) metres, minimum distance from the camera.
        number: of the group.
    """
    R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
    points = (corners - t) @ R
    a, b = points[:, edges[:, 0]], points[:, edges[:, 1]]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (_NEAR - a[..., 2:]) / (b[..., 2:] - a[..., 2:])
        cut = np.where((share > 0) & (share < 1), a + share * (b - a), np.nan)
    points = np.concatenate([points, cut], axis=1)
    z = points[..., 2]
    ahead = z >= _NEAR * (1.0 - 1e-9)
    _, height, width = lens.direction.shape
    bounds = []
    with np.errstate(divide="ignore", invalid="ignore"):
        for axis, size in ((0, width), (1, height)):
            pixel = lens.K[axis, axis] * points[..., axis] / z + lens.K[axis, 2]
            low = np.where(ahead, pixel, np.inf).min(axis=1) - lens.bends - 1.0
            high = np.where(ahead, pixel, -np.inf).max(axis=1) + lens.bends + 1.0
            bounds += [np.clip(low, 0, size), np.clip(high + 1.0, 0, size)]
    left, right, top, bottom = bounds
    for k in np.flatnonzero(ahead.any(axis=1) & (left < right) & (top < bottom)).tolist():
        rows, columns = slice(int(top[k]), int(bottom[k])), slice(int(left[k]), int(right[k]))
        yield _Candidate(float(near[k]), number, k, rows, columns)
