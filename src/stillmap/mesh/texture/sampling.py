"""Sampling of images between their pixels, and of textured meshes at points."""

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.mesh.texture.atlas import GRAY, TexturedMesh
from stillmap.mesh.types import Bool, Float, Float32, Image

_OTHER_GRAY = (128, 128, 127)  # stands for an image's gray, as GRAY means no color


def downsample(image: NDArray[np.generic], times: int) -> Float32:
    """(h / 2^times, w / 2^times, 3) float32 means of squares; borders are repeated to fill them."""
    out: Float32 = np.asarray(image, np.float32)
    for _ in range(times):
        h, w = out.shape[:2]
        out = np.pad(out, [(0, h % 2), (0, w % 2), (0, 0)], mode="edge")
        out = 0.25 * (out[::2, ::2] + out[1::2, ::2] + out[::2, 1::2] + out[1::2, 1::2])
    return out


def sample_bilinear(image: NDArray[np.generic], uv: Float) -> Float32:
    """(n, 3) values of an image (h, w, 3) at columns and rows (n, 2), interpolated as stored.

    Pixel centers have whole numbers; beyond the outermost centers the nearest value counts.
    """
    h, w = image.shape[:2]
    u, v = np.clip(uv[:, 0], 0.0, w - 1.0), np.clip(uv[:, 1], 0.0, h - 1.0)
    left, top = np.minimum(u.astype(np.int64), max(w - 2, 0)), v.astype(np.int64)
    top = np.minimum(top, max(h - 2, 0))
    a, b = (u - left).astype(np.float32)[:, None], (v - top).astype(np.float32)[:, None]
    right, down = min(1, w - 1), min(1, h - 1) * w
    flat, at = image.reshape(-1, 3), top * w + left
    upper = flat[at] * (1 - a) + flat[at + right] * a
    lower = flat[at + down] * (1 - a) + flat[at + down + right] * a
    return np.asarray(upper * (1 - b) + lower * b, np.float32)


class TextureSampler:
    """Looks up the colors of points on a textured mesh.

    Args:
        textured: F faces.
        max_distance: metres of a point from a face.
    """

    def __init__(self, textured: TexturedMesh, max_distance: float) -> None:
        self._of = textured
        self._mesh = _core.MeshDistance(
            textured.vertices, textured.faces, max_distance=max_distance
        )
        # the last entry stands for no face
        self._page = np.append(np.where(textured.view >= 0, textured.page, -1), -1)

    def colors(self, points: Float, origins: Float) -> tuple[Image, Bool]:
        """(n, 3) uint8 colors, none of them GRAY, and whether (n,) there are any.

        The color at the closest place on faces that face the point's sensor.

        Args:
            points: (n, 3) metres.
            origins: (n, 3) position of the sensor for each.
        """
        places = np.ascontiguousarray(points), np.ascontiguousarray(origins)
        face, weight = self._mesh.closest_faces(*places)
        found = self._page[face]
        out = np.zeros((len(points), 3), np.uint8)
        for page, texels in enumerate(self._of.pages):
            mine = np.flatnonzero(found == page)
            corner, share = self._of.faces[face[mine]], weight[mine]
            uv = sum(share[:, k, None] * self._of.uv[corner[:, k]] for k in range(3))
            h, w = texels.shape[:2]
            out[mine] = np.rint(sample_bilinear(texels, uv * np.array([w, h], np.float64) - 0.5))
        return avoid_gray(out), found >= 0


def avoid_gray(colors: Image) -> Image:
    """(n, 3) the colors with GRAY, which means that there is none, replaced by its neighbor."""
    is_gray = (colors == GRAY).all(axis=1, keepdims=True)
    return np.where(is_gray, np.array(_OTHER_GRAY, np.uint8), colors)
