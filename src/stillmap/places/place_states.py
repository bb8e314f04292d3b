"""The E-step over sessions: the cells of a place in which anything stood, and their states."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.short_repr import ShortRepr
from stillmap.core.square_box import neighbor_pairs
from stillmap.places import session_hmm
from stillmap.places.beam_cells import cell_keys
from stillmap.places.evidence import BLOCK, Bytes, Evidence, crop_without_gaps, to_sums
from stillmap.places.session_hmm import CellStates

Float = NDArray[np.float64]
Cells = NDArray[np.int64]

_BLOCKS_PER_TILE = 8  # along each axis
# cells: within so many of each other two surfaces are the same; around a cell that must be passed
TOLERANCE, _FREE_RADIUS = 1, 1
_CANDIDATE_RADIUS = {2: 2, 3: 1}  # cells within which hits of one surface scatter
MIN_HITS = 0.75  # expected static hits of a session that make a cell a candidate
_MIN_PROMINENCE = 0.2  # share of the hits of the most-hit cell within that radius
_POOL_RADIUS = 3.0  # cells within which those of one history decide together
_MAX_FIT_ROWS = 50_000  # cells that the weights are fitted to


class Tile(NamedTuple):
    """A box of cells: its lowest cell (D,) and its shape."""

    low: Cells
    shape: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class PlaceStates(ShortRepr):
    """Cells of a place in which something stood in some session.

    Attributes:
        cells: (K, D) int64, sorted by tile.
        evidence: (K, S) float32, nats, see `session_hmm`; sessions in the order of time.
        own: (K, S) float32, nats, the same without a tolerance: of each cell by itself.
        states: of each cell over the sessions.
        resolution: m, edge of a cell.
        weights: (3,) of static, free and changing cells.
    """

    cells: Cells
    evidence: NDArray[np.float32]
    own: NDArray[np.float32]
    states: CellStates
    resolution: float
    weights: Float

    def look_up(self, points: Float, values: Float) -> Float:
        """(n,) values (K,) of the cells that hold points (n, D); 0 where nothing ever stood."""
        key, order = self._index()
        wanted = cell_keys(np.floor(points / self.resolution).astype(np.int64))
        at = np.minimum(np.searchsorted(key, wanted), max(len(key) - 1, 0))
        if not len(key):
            return np.zeros(len(points))
        return np.where(key[at] == wanted, values[order[at]], 0.0)

    def _index(self) -> tuple[NDArray[np.int64], NDArray[np.intp]]:
        key = cell_keys(self.cells)
        order = np.argsort(key)
        return key[order], order

    def with_evidence(
        self, evidence: NDArray[np.float32], changed: NDArray[np.intp]
    ) -> "PlaceStates":
        """The same with other evidence (K, S) of the cells `changed` (n,)."""
        states = session_hmm.estimate_states(evidence[changed].astype(np.float64), self.weights)
        columns = {name: np.array(getattr(self.states, name)) for name in vars(states)}
        for name, column in columns.items():
            column[changed] = getattr(states, name)
        return replace(self, evidence=evidence, states=CellStates(**columns))


def measure_overlap(sessions: Sequence[Evidence], index: int) -> float:
    """Share of the hits of a session in cells that another one observed."""
    known = total = 0
    for tile in iter_tiles([sessions[index]]):
        hits, _ = sessions[index].crop(*tile)
        total += int(hits.sum())
        seen = np.zeros(tile.shape, np.bool_)
        for k, other in enumerate(sessions):
            if k != index:
                seen |= np.bitwise_or(*other.crop(*tile)) > 0
        known += int(hits[seen].sum())
    return known / max(total, 1)


def estimate_place(sessions: Sequence[Evidence]) -> PlaceStates:
    """The states of all cells over the sessions.

    Args:
        sessions: evidence of each in the frame of the place, in the order of time.
    """
    D = sessions[0].dimension
    cells, observed = [np.zeros((0, D), np.int64)], [np.zeros((2, 0, len(sessions)), np.float32)]
    for tile in iter_tiles(sessions):
        of_tile, nats = _observe_tile(sessions, tile)
        cells.append(of_tile)
        observed.append(nats)
    table, own = np.concatenate(observed, axis=1)
    step = max(-(-len(table) // _MAX_FIT_ROWS), 1)
    weights = session_hmm.fit_weights(table[::step].astype(np.float64))
    all_cells = np.concatenate(cells)
    pairs = neighbor_pairs(all_cells, _POOL_RADIUS)
    states = session_hmm.estimate_states(table.astype(np.float64), weights, pairs)
    return PlaceStates(all_cells, table, own, states, sessions[0].resolution, weights)


def iter_tiles(sessions: Sequence[Evidence]) -> Iterator[Tile]:
    """The tiles in which sessions observed anything, in order."""
    D = sessions[0].dimension
    size = BLOCK[D] * _BLOCKS_PER_TILE
    lows = np.concatenate([one.corner // size * size for one in sessions])
    for low in np.unique(lows, axis=0).astype(np.int64):
        yield Tile(low, (size,) * D)


def _observe_tile(sessions: Sequence[Evidence], tile: Tile) -> tuple[Cells, NDArray[np.float32]]:
    """Candidate cells (k, D) of a tile, and the evidence (2, k, S) of every session: with the
    tolerance, and of each cell by itself."""
    D = len(tile.shape)
    halo = _CANDIDATE_RADIUS[D]
    low, shape = tile.low - halo, tuple(n + 2 * halo for n in tile.shape)
    inner = (slice(halo, -halo),) * D
    sums = [crop_without_gaps(one, low, shape) for one in sessions]
    at = np.nonzero(_find_candidates([hits for hits, _ in sums], halo)[inner])
    nats = np.empty((2, len(at[0]), len(sessions)), np.float32)
    for s, (hits, passes) in enumerate(sums):
        share = hits / np.maximum(passes + hits.astype(np.float32), np.float32(1.0))
        for out, tolerance, around in ((0, TOLERANCE, _FREE_RADIUS), (1, 0, 0)):
            most = _reduce_around(hits, tolerance, np.maximum)[inner][at]
            fewest = _reduce_around(passes, around, np.minimum)[inner][at]
            stopped = _reduce_around(share, tolerance, np.maximum)[inner][at]
            nats[out, :, s] = session_hmm.weigh_evidence(to_sums(most), to_sums(fewest), stopped)
    return np.stack(at, axis=1) + tile.low, nats


def _find_candidates(hits: Sequence[Bytes], radius: int) -> NDArray[np.bool_]:
    """The cells in which something stood in some session, and that are no noise of a wall."""
    out = np.zeros(hits[0].shape, np.bool_)
    for of in hits:
        at = np.nonzero(of)
        own, strongest = (to_sums(c[at]) for c in (of, _reduce_around(of, radius, np.maximum)))
        out[at] |= own >= np.maximum(MIN_HITS, _MIN_PROMINENCE * strongest)
    return out


def _reduce_around(cells: NDArray[Any], radius: int, reduce: "np.ufunc") -> NDArray[Any]:
    """The extreme of all cells within a radius along each axis; cells at the border stay.

    Shifted copies take a tenth of the time of a filter of SciPy.
    """
    for axis in range(cells.ndim if radius else 0):
        n, out = cells.shape[axis] - 2 * radius, cells.copy()
        inner = out[(slice(None),) * axis + (slice(radius, radius + n),)]
        for shift in range(2 * radius + 1):
            reduce(inner, cells[(slice(None),) * axis + (slice(shift, shift + n),)], out=inner)
        cells = out
    return cells
