"""Small pieces of a map: walls are long, remains of moving objects and of wrong poses are not."""

import numpy as np

from stillmap.core.components import adjacent_pairs, component_labels
from stillmap.core.tiles import tiles_of
from stillmap.em import OccupancyMap

_OCCUPIED = 0.65  # P(occupied) above which map_server and nav2 take a cell for occupied
_SMALL = 0.3  # m, extent along either axis below which a piece is small
_AREA = 100.0  # m2


def count_small_pieces(occupancy: OccupancyMap) -> float | None:
    """Pieces smaller than 0.3 m per 100 m2 of known area; None where nothing is occupied.

    A piece is a component of occupied cells, of which all eight neighbours are connected.
    """
    known, found = 0, [np.empty((0, 2), np.int64)]
    for (rows, columns), part in tiles_of(occupancy.p_occupied):
        known += int(np.count_nonzero(~np.isnan(part)))
        corner = np.array([rows.start or 0, columns.start or 0])
        found.append(np.argwhere(part > _OCCUPIED) + corner)
    cells = np.concatenate(found)
    if not len(cells):
        return None
    piece = component_labels(adjacent_pairs(cells), len(cells))
    low = np.full((piece.max() + 1, 2), np.iinfo(np.int64).max)
    high = np.full_like(low, np.iinfo(np.int64).min)
    np.minimum.at(low, piece, cells)
    np.maximum.at(high, piece, cells)
    extent = (high - low + 1).max(axis=1) * occupancy.resolution
    small = int(np.count_nonzero(extent < _SMALL))
    return _AREA * small / (known * occupancy.resolution**2)
