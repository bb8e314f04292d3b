"""Pictures of one exposure: each is brightened until it agrees with others on what they share."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, eye_array
from scipy.sparse.linalg import spsolve

from stillmap.core.camera import Images
from stillmap.mesh.texture.views import View

Float = NDArray[np.float64]
Colours = NDArray[np.float32]
Index = NDArray[np.integer]

_DARK, _BRIGHT = 16.0, 240.0  # of 255: beyond these a value may be cut off
_FEWEST = 30  # faces that two pictures must share
_SURE = 100.0  # from about so many on, more of them make what they say no surer
_SPREAD = 0.05  # of their differences; what is spread wider tells less
_BETTER = 0.9  # of what they differed by, at most, they must differ by then
_STAY = 0.01  # what it costs to brighten a picture, beside what it costs to differ from another
_MOST = np.log(2.0)


def estimate_gains(picture: NDArray[np.int32], colours: Colours, n: int) -> Float:
    """(n, 3) factors for red, green and blue of n pictures, by which they agree best.

    A value of a pixel is about a power of the light, so a factor of exposure, or of the balance of
    white, is one of values, too. Of each two pictures the median tells by how much one is brighter
    on the faces that they share: people, gloss, and edges that lie beside each other do not count.
    With g the logarithms of the factors, d_ij these medians, and w_ij how sure they are,

        sum_ij w_ij (g_i - g_j - d_ij)^2 + 0.01 sum_i g_i^2

    is least; the last part holds the whole as bright as it is. All are 1 where pictures do not
    agree clearly better then: moving shadows make pictures of one exposure differ, too.

    Args:
        picture: (F, K) which pictures show each face, -1: none.
        colours: (F, K, 3) what they show there, 0 to 255; NaN: unknown.
        n: how many pictures there are.
    """
    one, other, brighter = _pairs(picture, colours)
    pair, of = np.unique(one.astype(np.int64) * n + other, return_inverse=True)
    count = np.bincount(of, minlength=len(pair))
    kept = np.flatnonzero(count >= _FEWEST)
    if not len(kept):
        return np.ones((n, 3))
    d = np.stack([_medians(of, brighter[:, c], count) for c in range(3)], axis=1)
    spread = _medians(of, np.abs(brighter - d[of]).max(axis=1), count)
    w = count / (count + _SURE) / (1.0 + (spread / _SPREAD) ** 2)
    g = _solved(pair[kept] // n, pair[kept] % n, w[kept], d[kept], n)
    left = np.median(np.abs(brighter + g[other] - g[one]))
    if left > _BETTER * np.median(np.abs(brighter)):
        return np.ones((n, 3))
    return np.asarray(np.exp(g))


def _solved(i: Index, j: Index, w: Float, d: Float, n: int) -> Float:
    """(n, 3) the g of least sum, of m pairs i, j (m,), w (m,), d (m, 3)."""
    rows, columns = np.concatenate([i, j, i, j]), np.concatenate([i, j, j, i])
    normal = coo_array((np.concatenate([w, w, -w, -w]), (rows, columns)), shape=(n, n)).tocsc()
    right = np.zeros((n, 3))
    np.add.at(right, i, w[:, None] * d)
    np.add.at(right, j, -w[:, None] * d)
    g = spsolve(normal + _STAY * eye_array(n, format="csc"), right).reshape(n, 3)
    return np.asarray(np.clip(g, -_MOST, _MOST), np.float64)


def _pairs(
    picture: NDArray[np.int32], colours: Colours
) -> tuple[NDArray[np.int32], NDArray[np.int32], Colours]:
    """Numbers (m,) of two pictures that show one face, the lower one first, and by how much the
    other is brighter, (m, 3) logarithms: each face's best with all others, and neighbours."""
    with np.errstate(invalid="ignore"):
        usable = ((colours >= _DARK) & (colours <= _BRIGHT)).all(axis=2) & (picture >= 0)
    K = picture.shape[1]
    ones, others, found = [], [], []
    for a, b in sorted({(0, k) for k in range(1, K)} | {(k - 1, k) for k in range(1, K)}):
        face = np.flatnonzero(usable[:, a] & usable[:, b])
        low, high = picture[face, a], picture[face, b]
        brighter = np.log(colours[face, b] / colours[face, a])
        ones.append(np.minimum(low, high))
        others.append(np.maximum(low, high))
        found.append(np.where((low < high)[:, None], brighter, -brighter))
    if not ones:
        return np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros((0, 3), np.float32)
    return np.concatenate(ones), np.concatenate(others), np.concatenate(found)


def _medians(of: NDArray[np.intp], values: Colours, count: NDArray[np.intp]) -> Float:
    """(m,) of each of m groups the median of its values; of an even number the lower one."""
    order = np.lexsort((values, of))
    middle = np.cumsum(count) - count + (count - 1) // 2
    return np.asarray(values[order[middle]], np.float64)


def apply_gains(images: Images, views: Sequence[View], gain: Float) -> Images:
    """The same pictures, those of views (n,) times gains (n, 3); of 8 bits, cut off at 255."""
    of = {view.image: np.asarray(one) for view, one in zip(views, gain, strict=True)}

    def load(image: int) -> NDArray[Any]:
        picture = images.read(image)
        if image not in of or picture.dtype != np.uint8:
            return picture
        tables = np.rint(np.arange(256)[:, None] * of[image]).clip(0, 255).astype(np.uint8)
        if picture.ndim == 2:
            return np.asarray(tables[picture, 0])
        out = picture.copy()
        for channel in range(3):
            out[..., channel] = tables[picture[..., channel], channel]
        return out

    return replace(images, load=load)
