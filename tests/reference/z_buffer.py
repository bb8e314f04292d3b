"""Rendering of a mesh by intersecting the ray of each pixel with every face."""

import numpy as np


def render_z_buffer(vertices, faces, K, T_camera_map, width, height, *, near):
    """Depth (height, width), inf for background, and face, -1 for background.

    The ray z (x, y, 1) of a pixel meets a face a, b, c where z (x, y, 1) = i a + j b + k c with
    i + j + k = 1: by Cramer's rule i is to j is to k as (x, y, 1) . (b x c) is to
    (x, y, 1) . (c x a) is to (x, y, 1) . (a x b), and all of them have the sign of a . (b x c).
    """
    R, t = T_camera_map[:3, :3], T_camera_map[:3, 3]
    points = [(R[:, 0] * p[0] + R[:, 1] * p[1] + R[:, 2] * p[2]) + t for p in vertices]
    v, u = np.mgrid[:height, :width].astype(float)
    y = (v - K[1, 2]) / K[1, 1]
    rays = np.stack([(u - K[0, 2] - K[0, 1] * y) / K[0, 0], y, np.ones_like(u)], axis=-1)
    depth = np.full((height, width), np.inf, np.float32)
    face = np.full((height, width), -1, np.int32)
    for number, at in enumerate(faces):
        a, b, c = (points[i] for i in at)
        z = _ray_depths(rays, a, b, c)
        z[~(z >= near)] = np.inf
        nearer = z.astype(np.float32) < depth
        depth[nearer], face[nearer] = z[nearer], number
    return depth, face


def _ray_depths(rays, a, b, c):
    """Depths at which rays (h, w, 3) intersect a face, inf where they do not."""
    volume = float(np.dot(a, np.cross(b, c)))
    across = np.stack([rays @ np.cross(p, q) for p, q in ((b, c), (c, a), (a, b))], axis=-1)
    across *= np.sign(volume)
    total = across.sum(axis=-1)
    inside = (across >= 0.0).all(axis=-1) & (total > 0.0)
    z = np.full(inside.shape, np.inf)
    z[inside] = np.clip(abs(volume) / total[inside], min(a[2], b[2], c[2]), max(a[2], b[2], c[2]))
    return z
