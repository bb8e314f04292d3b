"""Search for alignments of two maps, without a prior: their correlation over all positions and
headings.

Under the right alignment surfaces of one map lie on surfaces of the other, or where that one saw
nothing, and nowhere in its free space. Both are counted at once, over whole maps, so that a small
overlap counts as much as a large one that fits by half. For each heading the sums over all
positions are products of Fourier transforms.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.places.surface_map import CONFLICT_WEIGHT, SurfaceMap

Float = NDArray[np.float64]
Raster = NDArray[np.float32]

_CELL, _MAX_CELLS = 0.3, 1000  # m, and cells along an edge: larger maps get larger cells
_TURN_CELLS = 1.7  # by which the surfaces move from one heading to the next, on average
_HEADINGS = (90, 720)  # fewest and most
_PER_HEADING, _MAX_FOUND = 8, 30  # optima that are kept
_SAME_CELLS, _SAME_TURNS = 2.7, 2.7  # within which of a better one an optimum is the same


class _Optimum(NamedTuple):
    """An alignment: its score, where the middle of the session lies (m), and the heading (rad)."""

    score: float
    x: float
    y: float
    heading: float


def search_alignments(
    place: SurfaceMap,
    session: SurfaceMap,
    free_weight: float = CONFLICT_WEIGHT,
    gone_weight: float = CONFLICT_WEIGHT,
) -> list[Float]:
    """T_place_session (3, 3) about where the maps agree most, the best one first.

    Each is within about a cell of the search, and the step of its headings, of an optimum.

    Args:
        place: the map that is searched.
        session: in its own frame.
        free_weight: of a surface of the session in the free space of the place, against one that
            both show.
        gone_weight: likewise of a surface of the place in the free space of the session.
    """
    if not len(place.surface) or not len(session.surface):
        return []
    search = _Search(place, session, free_weight, gone_weight)
    headings = np.arange(search.headings) * (2.0 * np.pi / search.headings)
    found = [one for heading in headings.tolist() for one in search.find_optima(heading)]
    found.sort(key=lambda one: -one.score)
    return [search.to_alignment(one) for one in _remove_duplicates(found, search)]


class _Search:
    """Two maps on cells, and their correlation for one heading after the other."""

    def __init__(
        self, place: SurfaceMap, session: SurfaceMap, free_weight: float, gone_weight: float
    ) -> None:
        from scipy import fft, ndimage  # slow to load

        self._fft = fft
        self._place, self._session = place, session
        self.middle = middle_of(session)
        offset = session.surface - self.middle
        spread = float(np.sqrt(np.square(offset).sum(axis=1).mean()))
        squares, self._half = self._choose_cells()
        self.cell = squares * place.edge
        turns = 2.0 * np.pi * spread / (_TURN_CELLS * self.cell)
        self.headings = int(np.clip(np.ceil(turns), *_HEADINGS))
        self._offset = offset
        field = _pool(_make_field(place, squares, free_weight), squares)
        own = _make_field(session, squares, gone_weight)
        self._field = np.pad(ndimage.uniform_filter(own, squares), 1)
        self._low = place.low * place.edge
        counts = _count((place.surface - self._low) / self.cell, field.shape)
        self._shape = tuple(fft.next_fast_len(n + 2 * self._half, real=True) for n in field.shape)
        self._inside = field.shape
        self._places = fft.rfft2(field, self._shape), fft.rfft2(counts, self._shape)
        self._axis = (np.arange(2 * self._half) - self._half + 0.5) * self.cell

    def _choose_cells(self) -> tuple[int, int]:
        """Squares along a cell of the search, and cells from the session's middle to its rim."""
        place, session = self._place, self._session
        corners = np.array([(x, y) for x in (0, 1) for y in (0, 1)]) * session.near.shape
        rim = (corners + session.low) * session.edge - self.middle
        reach = float(np.linalg.norm(rim, axis=1).max())
        extent = max(place.near.shape) * place.edge + 2.0 * reach
        squares = max(round(_CELL / place.edge), 1, int(np.ceil(extent / _MAX_CELLS / place.edge)))
        return squares, int(np.ceil(reach / (squares * place.edge))) + 1

    def find_optima(self, heading: float) -> list[_Optimum]:
        """The best positions under a heading."""
        rotated = self._offset @ _rotation(heading).T
        counts = _count(rotated / self.cell + self._half, (2 * self._half, 2 * self._half))
        field = self._rotate_field(heading)
        rfft2 = self._fft.rfft2
        of_place, of_counts = self._places
        product = of_place * np.conj(rfft2(counts, self._shape))
        product += of_counts * np.conj(rfft2(field, self._shape))
        score = self._fft.irfft2(product, self._shape)
        at = _find_maxima(score, _PER_HEADING)
        cells = np.stack(np.unravel_index(at, self._shape), axis=1)
        cells -= np.where(cells >= self._inside, self._shape, 0)  # shifts to the other side
        xy = (cells + self._half) * self.cell + self._low
        values = score.ravel()[at].tolist()
        return [
            _Optimum(value, x, y, heading)
            for value, (x, y) in zip(values, xy.tolist(), strict=True)
        ]

    def _rotate_field(self, heading: float) -> Raster:
        """The session's field on cells about its middle; 0 where nothing is known."""
        c, s = float(np.cos(heading)), float(np.sin(heading))
        edge, (low_x, low_y) = self._session.edge, (self._session.low - 1).tolist()
        x, y = self._axis * (c / edge), self._axis * (s / edge)
        mx, my = (self.middle / edge).tolist()
        # squares of the ring around the field are unknown, as all beyond it
        rows = np.floor(x[:, None] + (y + (mx - low_x))).astype(np.int32)
        columns = np.floor(x + (my - low_y) - y[:, None]).astype(np.int32)
        height, width = self._field.shape
        np.clip(rows, 0, height - 1, out=rows)
        np.clip(columns, 0, width - 1, out=columns)
        rows *= width
        rows += columns
        out: Raster = self._field.ravel().take(rows)
        return out

    def to_alignment(self, one: _Optimum) -> Float:
        """T_place_session (3, 3)."""
        back = se2.matrix(-self.middle[0], -self.middle[1], 0.0)
        out: Float = se2.matrix(one.x, one.y, one.heading) @ back
        return out


def _find_maxima(score: Raster, most: int) -> NDArray[np.intp]:
    """The highest positive values that none within two cells exceeds, the highest first: their
    flat indices. The raster goes on at its other side."""
    values, (X, Y) = score.ravel(), score.shape
    around = np.arange(-2, 3)
    for kept in (256, 4096, values.size):  # nearly always among the highest ones, which are few
        n = min(kept, values.size)
        limit = np.partition(values, values.size - n)[values.size - n]
        at = np.flatnonzero((values >= limit) & (values > 0.0))
        x, y = np.divmod(at, Y)
        rows = (x[:, None] + around) % X * Y
        near = rows[:, :, None] + ((y[:, None] + around) % Y)[:, None, :]
        found = at[values[at] >= values[near].max(axis=(1, 2))]
        if len(found) >= most or limit <= 0.0:
            break
    out: NDArray[np.intp] = found[np.argsort(-values[found], kind="stable")[:most]]
    return out


def middle_of(session: SurfaceMap) -> Float:
    """(2,) mean of the surfaces, m."""
    out: Float = session.surface.mean(axis=0, dtype=np.float64)
    return out


def _remove_duplicates(found: list[_Optimum], search: _Search) -> list[_Optimum]:
    """The best ones that lie apart from all better ones."""
    apart = _SAME_CELLS * search.cell
    turn = _SAME_TURNS * 2.0 * np.pi / search.headings
    out = list[_Optimum]()
    for one in found:
        if not any(
            np.hypot(one.x - other.x, one.y - other.y) <= apart
            and abs(float(se2.wrap(one.heading - other.heading))) <= turn
            for other in out
        ):
            out.append(one)
        if len(out) == _MAX_FOUND:
            break
    return out


def _make_field(known: SurfaceMap, squares: int, free_weight: float) -> Raster:
    """(X, Y) evidence for a surface on each square: 1 near one, -free_weight where it is free.

    Both with the tolerance that cells of so many squares need.
    """
    from scipy import ndimage

    around, steps = np.ones((3, 3), np.bool_), max(squares - 2, 0)
    near, free = known.near, known.free
    if steps:
        near = ndimage.binary_dilation(near, around, steps)
        free = ndimage.binary_erosion(free, around, steps)
    blocked = (free & ~near).astype(np.float32)
    out: Raster = near.astype(np.float32) - np.float32(free_weight) * blocked
    return out


def _pool(field: Raster, squares: int) -> Raster:
    """Means over cells of so many squares along each edge."""
    padded = np.pad(field, [(0, -n % squares) for n in field.shape])
    X, Y = (n // squares for n in padded.shape)
    out: Raster = padded.reshape(X, squares, Y, squares).mean(axis=(1, 3))
    return out


def _count(cells: NDArray[np.floating], shape: tuple[int, ...]) -> Raster:
    """Number of points in each cell; all points (n, 2) are inside."""
    x, y = np.floor(cells).astype(np.int64).T
    counts = np.bincount(x * shape[1] + y, minlength=shape[0] * shape[1])
    return counts.reshape(shape).astype(np.float32)


def _rotation(heading: float) -> Float:
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, -s], [s, c]])
