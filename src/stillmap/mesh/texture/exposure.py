"""Exposure compensation: color gains by which images agree on the faces that they share."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, eye_array
from scipy.sparse.linalg import spsolve

from stillmap.core.camera import Images
from stillmap.mesh.texture.views import View
from stillmap.mesh.types import Float, Float32, Index, Int32

_DARK, _BRIGHT = 16.0, 240.0  # of 255: beyond these a value may be clipped
_MIN_FACES = 30  # that two images must share
_HALF_WEIGHT_FACES = 100.0  # at which a pair has half of its full weight
_SPREAD = 0.05  # of log ratios; pairs with more spread weigh less
_MIN_IMPROVEMENT = 0.9  # of the former difference that may be left
_REGULARIZATION = 0.01  # weight of gains against differences
_MAX_LOG_GAIN = np.log(2.0)


def estimate_gains(view: Int32, colors: Float32, n: int) -> Float:
    """(n, 3) gains of red, green and blue by which n images agree best.

    Pixel values are about a power of the light, so exposure and white balance are factors of
    values, too. Each pair of images gives the median log ratio d_ij over the faces that they share,
    robust against people, gloss and misaligned edges. With g the log gains and w_ij the weights,

        sum_ij w_ij (g_i - g_j - d_ij)^2 + 0.01 sum_i g_i^2

    is minimised; the last term keeps the overall brightness. All gains are 1 where images do not
    agree clearly better then: moving shadows make images of one exposure differ, too.

    Args:
        view: (F, K) views of each face, -1: none.
        colors: (F, K, 3) their colors there, 0 to 255; NaN: unknown.
        n: number of images.
    """
    one, other, brighter = _log_ratios(view, colors)
    pair, of = np.unique(one.astype(np.int64) * n + other, return_inverse=True)
    count = np.bincount(of, minlength=len(pair))
    kept = np.flatnonzero(count >= _MIN_FACES)
    if not len(kept):
        return np.ones((n, 3))
    d = np.stack([_group_medians(of, brighter[:, c], count) for c in range(3)], axis=1)
    spread = _group_medians(of, np.abs(brighter - d[of]).max(axis=1), count)
    w = count / (count + _HALF_WEIGHT_FACES) / (1.0 + (spread / _SPREAD) ** 2)
    g = _solve(pair[kept] // n, pair[kept] % n, w[kept], d[kept], n)
    left = np.median(np.abs(brighter + g[other] - g[one]))
    if left > _MIN_IMPROVEMENT * np.median(np.abs(brighter)):
        return np.ones((n, 3))
    return np.asarray(np.exp(g))


def _solve(i: NDArray[np.integer], j: NDArray[np.integer], w: Float, d: Float, n: int) -> Float:
    """(n, 3) log gains of m pairs i, j (m,) with weights (m,) and log ratios (m, 3)."""
    rows, columns = np.concatenate([i, j, i, j]), np.concatenate([i, j, j, i])
    normal = coo_array((np.concatenate([w, w, -w, -w]), (rows, columns)), shape=(n, n)).tocsc()
    right = np.zeros((n, 3))
    np.add.at(right, i, w[:, None] * d)
    np.add.at(right, j, -w[:, None] * d)
    g = spsolve(normal + _REGULARIZATION * eye_array(n, format="csc"), right).reshape(n, 3)
    return np.asarray(np.clip(g, -_MAX_LOG_GAIN, _MAX_LOG_GAIN), np.float64)


def _log_ratios(view: Int32, colors: Float32) -> tuple[Int32, Int32, Float32]:
    """Pairs (m,), (m,) of images of one face, the lower number first, and the log ratio (m, 3) of
    the second to the first; of each face's best with all others, and of neighbors in rank."""
    with np.errstate(invalid="ignore"):
        usable = ((colors >= _DARK) & (colors <= _BRIGHT)).all(axis=2) & (view >= 0)
    K = view.shape[1]
    ones, others, ratios = [], [], []
    for a, b in sorted({(0, k) for k in range(1, K)} | {(k - 1, k) for k in range(1, K)}):
        face = np.flatnonzero(usable[:, a] & usable[:, b])
        low, high = view[face, a], view[face, b]
        brighter = np.log(colors[face, b] / colors[face, a])
        ones.append(np.minimum(low, high))
        others.append(np.maximum(low, high))
        ratios.append(np.where((low < high)[:, None], brighter, -brighter))
    if not ones:
        return np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros((0, 3), np.float32)
    return np.concatenate(ones), np.concatenate(others), np.concatenate(ratios)


def _group_medians(of: Index, values: Float32, count: Index) -> Float:
    """(m,) lower median of the values of each of m groups."""
    order = np.lexsort((values, of))
    middle = np.cumsum(count) - count + (count - 1) // 2
    return np.asarray(values[order[middle]], np.float64)


def apply_gains(images: Images, views: Sequence[View], gains: Float) -> Images:
    """The images with those of views (n,) multiplied by gains (n, 3), clipped at 255."""
    of = {view.image: np.asarray(one) for view, one in zip(views, gains, strict=True)}

    def load(number: int) -> NDArray[Any]:
        image = images.read(number)
        if number not in of or image.dtype != np.uint8:
            return image
        tables = np.rint(np.arange(256)[:, None] * of[number]).clip(0, 255).astype(np.uint8)
        if image.ndim == 2:
            return np.asarray(tables[image, 0])
        out = image.copy()
        for channel in range(3):
            out[..., channel] = tables[image[..., channel], channel]
        return out

    return replace(images, load=load)
