"""Colours of pictures between their pixels."""

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]
Picture = NDArray[np.uint8]


def halved(picture: NDArray[np.generic], times: int) -> Float32:
    """(h / 2^times, w / 2^times, 3) float32 means of squares; what is left at the edges counts as
    often as it takes to fill them."""
    out: Float32 = np.asarray(picture, np.float32)
    for _ in range(times):
        h, w = out.shape[:2]
        out = np.pad(out, [(0, h % 2), (0, w % 2), (0, 0)], mode="edge")
        out = 0.25 * (out[::2, ::2] + out[1::2, ::2] + out[::2, 1::2] + out[1::2, 1::2])
    return out


def bilinear(picture: NDArray[np.generic], uv: Float) -> Float32:
    """(n, 3) values of a picture (h, w, 3) at (n, 2) columns and rows, centres of pixels having
    whole numbers; beyond the outermost centres, of what is nearest there.

    Values are mixed as they are stored.
    """
    h, w = picture.shape[:2]
    u, v = np.clip(uv[:, 0], 0.0, w - 1.0), np.clip(uv[:, 1], 0.0, h - 1.0)
    left, top = np.minimum(u.astype(np.int64), max(w - 2, 0)), v.astype(np.int64)
    top = np.minimum(top, max(h - 2, 0))
    a, b = (u - left).astype(np.float32)[:, None], (v - top).astype(np.float32)[:, None]
    right, down = min(1, w - 1), min(1, h - 1) * w
    flat, at = picture.reshape(-1, 3), top * w + left
    upper = flat[at] * (1 - a) + flat[at + right] * a
    lower = flat[at + down] * (1 - a) + flat[at + down + right] * a
    return np.asarray(upper * (1 - b) + lower * b, np.float32)
