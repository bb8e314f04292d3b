"""Global alignment: where a session lies in a place, without a prior.

Whole maps are compared over all positions and headings by their correlation; the best alignments
are refined, and compared again square by square. Under the right one surfaces of one map lie on
surfaces of the other, or where that one saw nothing, and nowhere in its free space. Both are
counted at once, so that a small overlap counts as much as a large one that fits by half. For each
heading the sums over all positions are products of Fourier transforms.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core import se2
from stillmap.core.array_types import Float, Float32, Index, Int64
from stillmap.places.surface_map import CONFLICT_WEIGHT, Comparison, SurfaceMap, compare_maps
from stillmap.slam import motion_model

Raster = Float32

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
    optima = [optimum for heading in headings.tolist() for optimum in search.find_optima(heading)]
    optima.sort(key=lambda optimum: -optimum.score)
    return [
        _to_alignment(search.middle, optimum.x, optimum.y, optimum.heading)
        for optimum in _remove_duplicates(optima, search)
    ]


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
        squares, self._half = self._choose_cells()
        self.cell = squares * place.edge
        turns = 2.0 * np.pi * _spread(offset) / (_TURN_CELLS * self.cell)
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
        rotated = self._offset @ se2.matrix(0.0, 0.0, heading)[:2, :2].T
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
        optima = zip(values, xy.tolist(), strict=True)
        return [_Optimum(value, x, y, heading) for value, (x, y) in optima]

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
        return np.asarray(self._field.ravel().take(rows))


def _to_alignment(middle: Float, x: float, y: float, heading: float) -> Float:
    """T_place_session (3, 3) with the middle of the session at x, y and its heading."""
    back = se2.matrix(-middle[0], -middle[1], 0.0)
    return np.asarray(se2.matrix(x, y, heading) @ back)


def _spread(offset: Float) -> float:
    """m, root mean square of offsets (N, 2)."""
    return float(np.sqrt(np.square(offset).sum(axis=1).mean()))


def _find_maxima(score: Raster, most: int) -> Index:
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
        maxima = at[values[at] >= values[near].max(axis=(1, 2))]
        if len(maxima) >= most or limit <= 0.0:
            break
    return np.asarray(maxima[np.argsort(-values[maxima], kind="stable")[:most]])


def middle_of(session: SurfaceMap) -> Float:
    """(2,) mean of the surfaces, m."""
    return np.asarray(session.surface.mean(axis=0, dtype=np.float64))


def _remove_duplicates(optima: list[_Optimum], search: _Search) -> list[_Optimum]:
    """The best ones that lie apart from all better ones."""
    apart = _SAME_CELLS * search.cell
    turn = _SAME_TURNS * 2.0 * np.pi / search.headings
    out = list[_Optimum]()
    for optimum in optima:
        if not any(
            np.hypot(optimum.x - better.x, optimum.y - better.y) <= apart
            and abs(float(se2.wrap(optimum.heading - better.heading))) <= turn
            for better in out
        ):
            out.append(optimum)
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
    return np.asarray(near.astype(np.float32) - np.float32(free_weight) * blocked)


def _pool(field: Raster, squares: int) -> Raster:
    """Means over cells of so many squares along each edge."""
    padded = np.pad(field, [(0, -n % squares) for n in field.shape])
    X, Y = (n // squares for n in padded.shape)
    return np.asarray(padded.reshape(X, squares, Y, squares).mean(axis=(1, 3)))


def _count(cells: NDArray[np.floating], shape: tuple[int, ...]) -> Raster:
    """Number of points in each cell; all points (n, 2) are inside."""
    x, y = np.floor(cells).astype(np.int64).T
    counts = np.bincount(x * shape[1] + y, minlength=shape[0] * shape[1])
    return counts.reshape(shape).astype(np.float32)


_STEPS = (2.0, 1.0, 0.5)  # squares, by which an alignment is moved and turned
_MAX_MOVES = 12  # of each length
_BLUR = 1.0  # squares, std: so that a surface that lies nearer counts more
_MAX_POINTS = 1500  # of each map, evenly spread


class _Layer(NamedTuple):
    """A map: its blurred field, its lowest square, some of its surfaces, and how many each counts
    for."""

    field: Float32
    low: Int64
    points: Float
    weight: float


class MapRefiner:
    """Climbs to the alignment under which two maps agree most, nearby."""

    def __init__(self, place: SurfaceMap, session: SurfaceMap) -> None:
        self._place, self._session = _make_layer(place), _make_layer(session)
        self._edge, self._middle = place.edge, middle_of(session)
        self._spread = max(_spread(session.surface - self._middle), place.edge)

    def refine(self, T: Float) -> Float:
        """T_place_session (3, 3) of the optimum that steps of falling length reach."""
        x = np.array([*(T[:2, :2] @ self._middle + T[:2, 2]), np.arctan2(T[1, 0], T[0, 0])])
        best = self._score(x)
        for length in _STEPS:
            step = length * self._edge
            moves = np.diag([step, step, step / self._spread])
            for _ in range(_MAX_MOVES):
                tried = np.concatenate([x + moves, x - moves])
                scores = [self._score(candidate) for candidate in tried]
                k = int(np.argmax(scores))
                if scores[k] <= best:
                    break
                x, best = tried[k], scores[k]
        return _to_alignment(self._middle, *x.tolist())

    def _score(self, x: Float) -> float:
        """Evidence of both maps with the session's middle at x, y and its heading."""
        T = _to_alignment(self._middle, *x.tolist())
        back = self._look_up(self._session, self._place, se2.inverse(T))
        return self._look_up(self._place, self._session, T) + back

    def _look_up(self, known: _Layer, seen: _Layer, T: Float) -> float:
        points = seen.points @ T[:2, :2].T + T[:2, 2]
        at = np.floor(points / self._edge).astype(np.int64) - known.low
        inside = ((at >= 0) & (at < known.field.shape)).all(axis=1)
        x, y = at[inside].T
        return seen.weight * float(known.field[x, y].sum())


def _make_layer(known: SurfaceMap) -> _Layer:
    from scipy import ndimage  # slow to load

    field = known.near.astype(np.float32) - np.float32(CONFLICT_WEIGHT) * known.free
    step = max(len(known.surface) // _MAX_POINTS, 1)
    return _Layer(
        ndimage.gaussian_filter(field.astype(np.float32), _BLUR),
        known.low,
        known.surface[::step].astype(np.float64),
        float(step),
    )


_MAX_HYPOTHESES = 6
_RIVAL_DISTANCE, _RIVAL_ANGLE = 1.0, 0.1  # m, rad: alignments nearer to a better one are that one
_REGISTERED_POINTS = 2000  # of the session, evenly spread
_GRID_CELL = 0.1  # m
# likelihood field: std (m) around surfaces, radius in cells, floor; weight of a point, Newton steps
_FIELD: dict[str, Any] = {"sigma": 0.1, "radius": 2, "floor": 0.05, "unknown": 0.2}
_SCALE, _MAX_ITERATIONS = 0.2, 20
_NO_PRIOR = 1e3  # m, rad: std of a prior that says nothing
_MIN_KEPT = 0.95  # share of the score that registration, which knows no free space, must keep


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """An alignment of a session with a place.

    Attributes:
        T: (3, 3) T_place_session.
        comparison: of both maps under it.
    """

    T: Float
    comparison: Comparison


def propose_alignments(place: SurfaceMap, session: SurfaceMap) -> list[Hypothesis]:
    """Alignments of a session, the one under which both maps agree most first.

    Args:
        place: its surfaces and free space.
        session: those of the session, in its own frame.
    """
    proposed = search_alignments(place, session)
    if not proposed:
        return []
    refiner = MapRefiner(place, session)
    poses = [refiner.refine(T) for T in proposed]
    refined = [Hypothesis(T, compare_maps(place, session, T)) for T in poses]
    best = _distinct_hypotheses(refined, session)[:_MAX_HYPOTHESES]
    return _distinct_hypotheses(_register(place, session, best), session)


def _register(
    place: SurfaceMap, session: SurfaceMap, hypotheses: list[Hypothesis]
) -> list[Hypothesis]:
    """Hypotheses registered finer than squares, unless the maps then agree less."""
    n, grid = len(place.surface), _core.OccupancyGrid2D(_GRID_CELL, 0.0)
    surface = np.ascontiguousarray(place.surface, np.float32)
    weight = np.ones(n, np.float32)
    ends = np.array([0, n]), np.eye(3)[None]
    _core.add_end_points(grid, surface, np.ones(n, np.bool_), weight, *ends)
    chosen = spread_evenly(len(session.surface), _REGISTERED_POINTS)
    points = np.ascontiguousarray(session.surface[chosen], np.float32)
    weight, out = np.ones(len(points), np.float32), []
    for start in hypotheses:
        prior = motion_model.gaussian_prior(start.T, _NO_PRIOR, _NO_PRIOR)
        T, *_ = _core.register_scan(
            grid,
            points,
            weight,
            prior.T_map_base,
            prior.information,
            **_FIELD,
            information_scale=_SCALE,
            max_iterations=_MAX_ITERATIONS,
            window_translation=0.0,
            window_rotation=0.0,
            search_range=0.0,
            max_candidates=1,
            T_start=start.T,
        )
        registered = Hypothesis(T, compare_maps(place, session, T))
        kept = registered.comparison.score >= _MIN_KEPT * start.comparison.score
        out.append(registered if kept else start)
    return out


def _distinct_hypotheses(hypotheses: list[Hypothesis], session: SurfaceMap) -> list[Hypothesis]:
    """Those that put the session elsewhere than all better ones, the best first."""
    middle = np.append(middle_of(session), 1.0)
    out = list[Hypothesis]()
    for hypothesis in sorted(hypotheses, key=lambda each: -each.comparison.score):
        T = hypothesis.T
        distance = [float(np.linalg.norm((T - better.T) @ middle)) for better in out]
        turn = [abs(se2.parameters(se2.inverse(T) @ better.T)[2]) for better in out]
        if not any(
            d < _RIVAL_DISTANCE and a < _RIVAL_ANGLE for d, a in zip(distance, turn, strict=True)
        ):
            out.append(hypothesis)
    return out


def spread_evenly(count: int, max_chosen: int) -> list[int]:
    """At most so many of `count` indices, evenly spread."""
    chosen = np.unique(np.linspace(0, count - 1, min(count, max_chosen)).round().astype(np.intp))
    return list(chosen.tolist())
