"""Small places to look at, and cameras in them."""

from functools import lru_cache

import numpy as np

from stillmap import _core
from stillmap.core import camera as camera_module
from stillmap.core.camera import Camera
from stillmap.mesh.triangle_mesh import Mesh, concatenate_meshes
from stillmap.mesh.views import View
from stillmap.mesh.visibility import find_visible_faces

K = np.array([[300.0, 0.0, 199.5], [0.0, 300.0, 149.5], [0.0, 0.0, 1.0]])


def camera(width=400, height=300, K=K, model="", distortion=()):
    return Camera("camera", width, height, K, model, np.array(distortion, float), np.eye(4))


def looking(place, towards, image=0, of=None):
    """A view from a place towards another, upright."""
    place = np.asarray(place, float)
    z = np.asarray(towards, float) - place
    z = z / np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x = x / np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = x, np.cross(z, x), z
    T[:3, 3] = -T[:3, :3] @ place
    return View(image, image, of or camera(), T)


def rectangle(corner, a, b, n=1):
    """2 n^2 faces; seen from where `a` turns to `b` counter-clockwise."""
    s = np.linspace(0.0, 1.0, n + 1)
    u, v = (t.ravel()[:, None] for t in np.meshgrid(s, s, indexing="ij"))
    vertices = np.asarray(corner, float) + u * np.asarray(a, float) + v * np.asarray(b, float)
    i = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    first, second = [i, i + n + 1, i + n + 2], [i, i + n + 2, i + 1]
    faces = np.concatenate([np.stack(first, axis=1), np.stack(second, axis=1)])
    return Mesh(vertices, faces.astype(np.int32))


def box(low, high, n=1, inwards=False):
    """12 n^2 faces, seen from outside, or from within."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    x, y, z = np.diag(high - low)
    sides = [
        rectangle(low, y, x, n),
        rectangle(low + z, x, y, n),
        rectangle(low, x, z, n),
        rectangle(low + y, z, x, n),
        rectangle(low, z, y, n),
        rectangle(low + x, y, z, n),
    ]
    mesh = concatenate_meshes(sides)
    return Mesh(mesh.vertices, mesh.faces[:, ::-1].copy()) if inwards else mesh


def colour(points):
    """(n, 3) 0 to 255, of places in space: what everything is painted with."""
    slow = np.sin(points * np.array([3.0, 4.0, 5.0]) + np.array([0.0, 1.0, 2.0]))
    quick = np.sin(points @ np.array([[9.0, 5, -7], [-6, 11, 3], [8, -3, 12]]))
    return np.clip(128 + 70 * slow + 40 * quick, 0, 255)


@lru_cache(maxsize=8)
def rays_of(camera, finer):
    """(n, 3) the directions of all parts of a camera's pixels."""
    u, v = ((np.arange(n * finer) + 0.5) / finer - 0.5 for n in (camera.width, camera.height))
    return camera_module.unproject(camera, np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2))


def photograph(mesh, view, finer=2):
    """What a camera takes of a mesh painted with `colour`: (height, width, 3) uint8.

    By rays through parts of the pixels; black where there is nothing.
    """
    of = view.camera
    rays = rays_of(of, finer)
    wide = np.array([[2.0 * of.K[0, 0], 0, 2.0 * of.width], [0, 0, 0], [0, 0, 1]])
    wide[1, 1:] = 2.0 * of.K[1, 1], 2.0 * of.height
    size = 4 * of.width, 4 * of.height
    _, face = _core.render_z_buffer(
        mesh.vertices, mesh.faces, wide, view.T_camera_map, *size, near=0.01
    )
    column, row = np.rint(rays[:, :2] @ wide[:2, :2].T + wide[:2, 2]).astype(int).T
    seen = face[np.clip(row, 0, size[1] - 1), np.clip(column, 0, size[0] - 1)]
    corners = view.to_camera(mesh.vertices)[mesh.faces[seen]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    z = np.sum(normal * corners[:, 0], axis=1) / np.sum(normal * rays, axis=1)
    place = (rays * z[:, None] - view.T_camera_map[:3, 3]) @ view.T_camera_map[:3, :3]
    picture = np.where((seen >= 0)[:, None], colour(place), 0.0)
    parts = picture.reshape(of.height, finer, of.width, finer, 3)
    return np.rint(parts.mean(axis=(1, 3))).astype(np.uint8)


def furnished():
    """A crumpled room of 4 by 5 by 2.6 m with a block in it; seen from inside."""
    mesh = concatenate_meshes(
        [box([0, 0, 0], [4, 5, 2.6], 10, inwards=True), box([1.5, 2, 0], [2.3, 3, 0.9], 5)]
    )
    rng = np.random.default_rng(1)
    key, at = np.unique(np.round(mesh.vertices, 6), axis=0, return_inverse=True)
    vertices = key + rng.normal(0.0, 0.01, key.shape)
    return Mesh(vertices, at.ravel()[mesh.faces].astype(np.int32))


def all_round(of=None, n=8):
    """Views from two places in that room."""
    angles = 2.0 * np.pi * np.arange(n) / n
    places = [np.array([1.0, 1.0, 1.5]), np.array([3.0, 4.2, 1.4])]
    return [
        looking(places[i % 2], places[i % 2] + [np.cos(a), np.sin(a), -0.3 + 0.3 * (i % 3)], i, of)
        for i, a in enumerate(angles)
    ]


def sharpest(mesh, views):
    """(F,) int32 the view that shows each face largest, -1: none."""
    best, most = np.full(len(mesh), -1, np.int32), np.zeros(len(mesh))
    for number, view in enumerate(views):
        seen = find_visible_faces(mesh, view)
        better = seen > most
        best[better], most[better] = number, seen[better]
    return best
