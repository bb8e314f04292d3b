"""Comparison of two maps under an alignment: surfaces that both show, and that one contradicts."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.array_types import Bool, Float, Float32, Int64
from stillmap.core.short_repr import ShortRepr
from stillmap.core.square_box import bound_box
from stillmap.places.evidence import UNITS, Bytes, Evidence
from stillmap.places.place_states import iter_tiles

# blocks of the box around the evidence: up to which it is always whole, and at most
_LEAST_BLOCKS, _MOST_BLOCKS = 1 << 15, 1 << 20
_STEP = 2  # cells of the evidence along the edge of a square
# hits of a surface, passes of a cell known to be free, by the dimension of the sessions: what 3D
# sessions see of a bush or a fence at several heights is both at once
_LIMITS = {2: (0.75, 2.0), 3: (3.0, 6.0)}
# squares over which passed ones are averaged; slope of that from which a surface has one free side;
# cosine between the free sides of two surfaces below which they are two faces of a wall
_SIDE_BLUR, _MIN_SLOPE, _OPPOSITE = 2.0, 0.08, -0.3
_SHIFT, _MAX_SHIFTED = 0.4, 0.75  # m; share of the score that may be left after it
CONFLICT_WEIGHT = 5.0


class Comparison(NamedTuple):
    """Squares of surface of two maps where they overlap.

    Attributes:
        agree: that are surface in both.
        conflict: of one map where the other one observed free space.
    """

    agree: int
    conflict: int

    @property
    def score(self) -> float:
        """Squares in favour; one in conflict outweighs several: most places agree in part."""
        return self.agree - CONFLICT_WEIGHT * self.conflict


@dataclass(frozen=True, eq=False)
class SurfaceMap(ShortRepr):
    """Surfaces and free space on squares.

    Attributes:
        surface: (N, 2) float32, centres of the squares with undisputed surface, metres.
        low: (2,) int64, lowest square.
        near: (X, Y) bool, squares with surface and their neighbours.
        free: (X, Y) bool, squares known to be free, as all around them are.
        side: (X, Y, 2) float32, unit vectors towards what beams passed; 0 where they passed on
            both sides.
        edge: m, of a square.
    """

    surface: Float32
    low: Int64
    near: Bool
    free: Bool
    side: Float32
    edge: float

    def look_up(self, points: Float, sides: Float) -> Comparison:
        """Count surfaces near a surface with the same free side, and in free space.

        Rooms that look alike fit on the other face of a wall, too.

        Args:
            points, sides: (n, 2) in metres, and as of `side`.
        """
        at = self._squares_of(points)
        inside = ((at >= 0) & (at < self.near.shape)).all(axis=1)
        x, y = at[inside].T
        is_other_face = (self.side[x, y] * sides[inside]).sum(axis=1) < _OPPOSITE
        agree = self.near[x, y] & ~is_other_face
        return Comparison(int(agree.sum()), int(self.free[x, y].sum()))

    def is_near(self, points: NDArray[np.floating]) -> Bool:
        """(n,) whether points (n, 2) in metres lie near a surface."""
        at = self._squares_of(points)
        out = np.zeros(len(at), np.bool_)
        inside = ((at >= 0) & (at < self.near.shape)).all(axis=1)
        x, y = at[inside].T
        out[inside] = self.near[x, y]
        return out

    @property
    def surface_sides(self) -> Float:
        """(N, 2) the side of each surface."""
        x, y = self._squares_of(self.surface).T
        return np.asarray(self.side[x, y], np.float64)

    def _squares_of(self, points: NDArray[np.floating]) -> Int64:
        return np.asarray(np.floor(points / self.edge).astype(np.int64) - self.low)


def make_surface_map(sessions: Sequence[Evidence], dimension: int = 2) -> SurfaceMap:
    """The surfaces of some sessions, in the frame of their evidence.

    Free is what none of them saw occupied, and surface what none passed: where sessions differ,
    neither is known. Else all that ever stood somewhere would speak against a further session.
    What is far from most of it is left out, see `bound_box`.

    Args:
        sessions: evidence of each in the plane.
        dimension: of the sessions before they were projected to the plane, 2 or 3.
    """
    from scipy import ndimage  # slow to load

    corners = np.concatenate([session.corner for session in sessions]).astype(np.int64)
    if not len(corners):  # nothing was seen: one empty tile
        corners = np.zeros((1, 2), np.int64)
    edge = sessions[0].edge
    box = bound_box(corners // edge, _LEAST_BLOCKS, _MOST_BLOCKS)
    low, shape = box.low * edge, tuple((edge * (box.high + 1 - box.low)).tolist())
    min_hits, min_passes = _LIMITS[dimension]
    hits, passes = np.zeros((2, *(n // _STEP for n in shape)), np.uint8)
    disputed = np.zeros(hits.shape, np.bool_)
    for tile in iter_tiles(sessions):
        first = np.maximum(tile.low, low)
        high = np.minimum(tile.low + tile.shape, low + shape)
        if (first >= high).any():
            continue
        part = tuple((high - first).tolist())
        spans = zip(first - low, part, strict=True)
        where = tuple(slice(int(f) // _STEP, int(f + n) // _STEP) for f, n in spans)
        for session in sessions:
            cells = session.crop(first, part)
            most, least = _pool(cells[0], np.maximum), _pool(cells[1], np.minimum)
            np.maximum(hits[where], most, out=hits[where])
            np.maximum(passes[where], least, out=passes[where])
            disputed[where] |= (most == 0) & (least >= UNITS * min_passes)
    surface = hits >= UNITS * min_hits
    near = ndimage.binary_dilation(surface, np.ones((3, 3), np.bool_))
    free = ndimage.binary_erosion(passes >= UNITS * min_passes, np.ones((3, 3), np.bool_)) & ~near
    square = _STEP * sessions[0].resolution
    squares = low // _STEP
    points = (np.argwhere(surface & ~disputed) + squares + 0.5) * square
    side = find_sides(passes > 0)
    return SurfaceMap(points.astype(np.float32), squares, near, free, side, square)


def find_sides(passed: Bool) -> Float32:
    """(X, Y, 2) unit vectors towards the squares (X, Y) that beams passed; 0 where these lie on
    both sides."""
    from scipy import ndimage  # slow to load

    field = passed.astype(np.float32)
    slopes = [ndimage.gaussian_filter(field, _SIDE_BLUR, order=order) for order in ((1, 0), (0, 1))]
    out = np.stack(slopes, axis=2)
    steep = np.linalg.norm(out, axis=2, keepdims=True)
    return np.where(steep < _MIN_SLOPE, 0.0, out / np.maximum(steep, 1e-9)).astype(np.float32)


def _pool(cells: Bytes, reduce: np.ufunc) -> Bytes:
    """Reduces squares of cells (X, Y) to one number each."""
    X, Y = (n // _STEP for n in cells.shape)
    return np.asarray(reduce.reduce(cells.reshape(X, _STEP, Y, _STEP), axis=(1, 3)))


def compare_maps(place: SurfaceMap, session: SurfaceMap, T_place_session: Float) -> Comparison:
    """Squares of both maps that agree, and that are in conflict, under an alignment (3, 3)."""
    forth, back = compare_surfaces(place, session, T_place_session)
    return Comparison(forth.agree + back.agree, forth.conflict + back.conflict)


def compare_surfaces(
    place: SurfaceMap, session: SurfaceMap, T_place_session: Float
) -> tuple[Comparison, Comparison]:
    """The surfaces of the session in the place, and those of the place in the session, under an
    alignment (3, 3)."""
    T, T_back = T_place_session, se2.inverse(T_place_session)
    forth = place.look_up(_transform(T, session.surface), session.surface_sides @ T[:2, :2].T)
    sides = place.surface_sides @ T_back[:2, :2].T
    return forth, session.look_up(_transform(T_back, place.surface), sides)


def is_determined(place: SurfaceMap, session: SurfaceMap, T_place_session: Float) -> bool:
    """True if the maps agree less wherever else the session is shifted to by a few decimetres.

    Along a bare corridor they agree as much.
    """
    score = compare_maps(place, session, T_place_session).score
    for angle in np.arange(8) * (np.pi / 4.0):
        shift = se2.matrix(_SHIFT * np.cos(angle), _SHIFT * np.sin(angle), 0.0)
        if compare_maps(place, session, shift @ T_place_session).score > _MAX_SHIFTED * score:
            return False
    return True


def _transform(T: Float, points: Float32) -> Float:
    return np.asarray(points @ T[:2, :2].T + T[:2, 2])
