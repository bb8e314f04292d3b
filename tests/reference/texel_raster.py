"""Rasterisation of triangles into texels."""

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Int32 = NDArray[np.int32]


def rasterise_texels(corners, width, height):
    """Texels (k,), triangles (k,), and barycentric weights (k, 2) of the second and third corner.

    A centre p is covered where p = a + j (b - a) + k (c - a) with j, k >= 0 and j + k <= 1.
    """
    row, column = (a.ravel() for a in np.mgrid[:height, :width])
    centre = np.stack([column, row], axis=1) + 0.5
    texel: list[Int32] = []
    weight: list[Float] = []
    for a, b, c in corners:
        at, jk = np.zeros(0, np.intp), np.zeros((0, 2))
        if np.linalg.det(spans := np.stack([b - a, c - a])) != 0.0:
            jk = np.linalg.solve(spans.T, (centre - a).T).T
            at = np.flatnonzero((jk >= 0.0).all(axis=1) & (jk.sum(axis=1) <= 1.0))
            jk = jk[at]
        if not len(at):
            u, v = np.clip(np.floor((a + b + c) / 3.0), 0, [width - 1, height - 1]).astype(int)
            at, jk = np.array([v * width + u]), np.full((1, 2), 1.0 / 3.0)
        texel.append(at.astype(np.int32))
        weight.append(jk)
    number = np.repeat(np.arange(len(texel)), [len(one) for one in texel])
    return (
        np.concatenate([np.zeros(0, np.int32), *texel]),
        number.astype(np.int32),
        np.concatenate([np.zeros((0, 2)), *weight]).astype(np.float32),
    )
