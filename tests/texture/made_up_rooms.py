"""Small places to look at, and cameras in them."""

import numpy as np

from stillmap.recording.images import Camera
from stillmap.surface.mesh import Mesh, joined
from stillmap.texture.view import View

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
    mesh = joined(sides)
    return Mesh(mesh.vertices, mesh.faces[:, ::-1].copy()) if inwards else mesh
