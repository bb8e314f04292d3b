"""The map of a place in the plane: what stands in the shown state, and what beams passed."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.square_box import bound_box
from stillmap.core.tiles import TILE, TiledArray, compact, crop
from stillmap.em import OccupancyMap
from stillmap.places.evidence import Evidence, to_sums
from stillmap.places.place_states import MIN_HITS, Tile, iter_tiles
from stillmap.places.shown_state import ShownState

Float = NDArray[np.float64]
Image = NDArray[np.float32]

# blocks of the box around the evidence: up to which it is always whole, and at most
_LEAST_BLOCKS, _MOST_BLOCKS = 1 << 17, 1 << 21

_FREE_PRIOR = 0.2  # occupancy of a cell that no beam passed; as of single recordings
# share of the hits of the most-hit cell, one and two cells around, below which it is its noise
_MIN_PROMINENCE, _MIN_FAR_PROMINENCE, _REACH = 0.25, 0.08, 2


def make_place_map(sessions: Sequence[Evidence], shown: ShownState) -> OccupancyMap:
    """The map of a place, in the plane, without what is far from most of it: see `bound_box`.

    Args:
        sessions: evidence of each in the plane.
        shown: the state that the map shows, of planar cells.
    """
    corners = np.concatenate([one.corner for one in sessions]).astype(np.int64)
    edge = sessions[0].edge
    box = bound_box(corners // edge, _LEAST_BLOCKS, _MOST_BLOCKS)
    corners = corners[box.contains(corners // edge)]
    low = corners.min(axis=0) // TILE * TILE
    width, height = ((corners.max(axis=0) - low) // TILE * TILE + TILE).tolist()
    layers = [TiledArray((height, width), np.float32, fill) for fill in (np.nan, 0.0, 0.0)]
    order, starts = _split_by_tile(shown)
    for tile in iter_tiles(sessions):
        if (tile.low < low).any() or (tile.low >= low + np.array([width, height])).any():
            continue
        cells = order[starts.get(tuple((tile.low // TILE).tolist()), slice(0, 0))]
        j, i = ((tile.low - low) // TILE).tolist()
        for layer, part in zip(layers, _draw_tile(sessions, tile, shown, cells), strict=True):
            layer.set_tile(i, j, part.T)
    first = corners.min(axis=0) - low
    last = corners.max(axis=0) + edge - low
    block = slice(int(first[1]), int(last[1])), slice(int(first[0]), int(last[0]))
    resolution = sessions[0].resolution
    x, y = ((low + first) * resolution).tolist()
    p_occupied, alpha, beta = (_crop(layer, block) for layer in layers)
    return OccupancyMap(p_occupied, (x, y, 0.0), resolution, alpha, beta)


def _crop(layer: TiledArray, block: tuple[slice, slice]) -> Any:
    """The part of a layer as an array."""
    return crop(compact(layer), block)


def _split_by_tile(
    shown: ShownState,
) -> tuple[NDArray[np.intp], dict[tuple[int, ...], slice]]:
    """Indices of the cells sorted by tile, and the slice of each tile."""
    tiles = shown.place.cells // TILE
    order = np.lexsort(tiles.T[::-1])
    keys, first = np.unique(tiles[order], axis=0, return_index=True)
    ends = np.append(first[1:], len(order))
    return order, {
        tuple(key): slice(int(a), int(b))
        for key, a, b in zip(keys.tolist(), first, ends, strict=True)
    }


def _draw_tile(
    sessions: Sequence[Evidence], tile: Tile, shown: ShownState, cells: NDArray[np.intp]
) -> tuple[Image, Image, Image]:
    """p_occupied, alpha and beta of a tile, x along the first axis."""
    from scipy import ndimage  # slow to load

    low, shape = tile.low - _REACH, tuple(n + 2 * _REACH for n in tile.shape)
    units = np.zeros((2, *shape), np.uint32)
    for one in sessions:
        for total, of_session in zip(units, one.crop(low, shape), strict=True):
            total += of_session
    hits, passes = to_sums(units)
    at = tuple((shown.place.cells[cells] - low).T)
    stands = np.zeros(shape, np.float32)
    stands[at] = shown.p_shown[cells]
    candidate = np.zeros(shape, np.bool_)
    candidate[at] = True
    # hits below the limit of a candidate may still be all that was seen of a far wall
    stands = np.where(candidate, stands, hits / (hits + passes + MIN_HITS))
    limit = np.full(shape, 1e-6, np.float32)
    for share, radius in ((_MIN_PROMINENCE, 1), (_MIN_FAR_PROMINENCE, _REACH)):
        strongest = ndimage.maximum_filter(hits * stands, 2 * radius + 1, mode="constant")
        limit = np.maximum(limit, share * strongest)
    prominence = hits / limit
    surface = stands * np.minimum(prominence, 1.0)
    odds = _FREE_PRIOR / (1.0 - _FREE_PRIOR) * np.exp(-passes)
    p_passed = odds / (1.0 + odds)
    p = np.where(hits + passes > 0.0, surface + (1.0 - surface) * p_passed, np.float32(np.nan))
    inner = (slice(_REACH, -_REACH),) * 2
    alpha = hits * stands
    return p[inner].astype(np.float32), alpha[inner], (passes + hits - alpha)[inner]
