"""What lies between the charts of a page, so that looking it up between texels shows no seams."""

import numpy as np
from numpy.typing import NDArray

_AROUND = [(r, c) for r in (-1, 0, 1) for c in (-1, 0, 1) if r or c]


def fill_gutters(page: NDArray[np.uint8], painted: NDArray[np.bool_], gutter: int) -> None:
    """Carries colours outwards over `gutter` texels, and gives the rest their mean; in place.

    Args:
        page: (h, w, 3).
        painted: (h, w) texels that have a colour; those that get one by being beside others are
            marked.
        gutter: how far.
    """
    h, w = painted.shape
    flat, mask = page.reshape(-1, 3), painted.reshape(-1)
    rest = flat[mask].mean(axis=0) if mask.any() else np.full(3, 128.0)
    for _ in range(gutter):
        row, column = np.nonzero(_grown(painted) & ~painted)
        total, count = np.zeros((len(row), 3), np.int32), np.zeros((len(row), 1), np.int32)
        for r, c in _AROUND:
            inside = (row + r >= 0) & (row + r < h) & (column + c >= 0) & (column + c < w)
            at = np.where(inside, (row + r) * w + column + c, 0)
            there = (mask[at] & inside)[:, None]
            total += np.where(there, flat[at], 0)
            count += there
        at = row * w + column
        flat[at] = (total + count // 2) // np.maximum(count, 1)
        mask[at] = True
    flat[~mask] = np.rint(rest).astype(np.uint8)


def _grown(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Those, and the eight around each."""
    out = mask.copy()
    out[1:] |= mask[:-1]
    out[:-1] |= mask[1:]
    wide = out.copy()
    wide[:, 1:] |= out[:, :-1]
    wide[:, :-1] |= out[:, 1:]
    return wide
