"""Mirrors: pieces of wall lines behind which beams see images of what is before them.

A mirror on the line n . x = d shows an end point x' = x - 2 (n . x - d) n of a surface at x. Its
evidence: what is seen through it lies on surfaces once it is reflected back, the reflected beams
reach them through free space, and wall at its back or around it shows that there is no opening.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from stillmap.core.array_types import Bool, Cells, Float, Index
from stillmap.core.square_box import cell_keys

_MIN_HITS, _MIN_DYNAMIC_HITS = 2, 5  # in a cell with a surface; mirrors make some look dynamic
_MAX_CELLS, _MAX_LINES = 10_000, 40
_ANGLES = 180  # directions of lines that are tried
_LINE_WIDTH = 0.1  # m, in which the cells of a line lie
_MAX_BINS = 1 << 17  # of the distances of lines, 6 km; of places farther apart gaps count as one
_MIN_LINE, _MIN_LINE_CELLS = 1.0, 5  # m and cells of wall on a line, such as frames of mirrors


class SurfaceCells:
    """Cells with a surface.

    Attributes:
        cells: (K, 2) columns and rows.
        keys: (L,) sorted numbers of these and the cells around them.
        own_keys: (K,) sorted numbers of these alone.
        resolution: m.
    """

    def __init__(self, points: Float, is_static: Bool, resolution: float) -> None:
        """The cells in which several of the points (N, 2) lie, fewer if they are static (N,)."""
        cells = np.floor(points / resolution).astype(np.int64)
        weight = np.where(is_static, 1.0 / _MIN_HITS, 1.0 / _MIN_DYNAMIC_HITS)
        own, first, number = np.unique(cell_keys(cells), return_index=True, return_inverse=True)
        enough = np.bincount(number, weights=weight, minlength=len(own)) > 1.0 - 1e-9
        self.cells, own = cells[first[enough]], own[enough]
        around = [self.cells + np.array([i, j]) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        self.keys = np.unique(cell_keys(np.concatenate(around)))
        self.own_keys, self.resolution = own, resolution

    def are_near(self, points: Float) -> Bool:
        """(...) whether there is a surface in the cells of points (..., 2) or around them."""
        return contains(self.keys, points, self.resolution)

    def are_in(self, points: Float) -> Bool:
        """(...) whether there is a surface in the cells of points (..., 2) themselves."""
        return contains(self.own_keys, points, self.resolution)


def contains(keys: Cells, points: Float, resolution: float) -> Bool:
    """(...) whether sorted numbers (L,) contain those of the cells of points (..., 2)."""
    wanted = cell_keys(np.floor(points / resolution).astype(np.int64))
    at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return np.asarray(keys[at] == wanted) if len(keys) else np.zeros(wanted.shape, np.bool_)


def iter_lines(cells: Cells, resolution: float) -> Iterator[tuple[Float, float]]:
    """Normals (2,) and distances of lines with many cells, longest first (Hough transform)."""
    centers = (cells[:: max(1, len(cells) // _MAX_CELLS)] + 0.5) * resolution
    if not len(centers):
        return
    angle = np.arange(_ANGLES) * (np.pi / _ANGLES)
    normals = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    bins = np.floor(centers @ normals.T / (0.5 * _LINE_WIDTH)).astype(np.int64)
    if int(np.ptp(bins)) > _MAX_BINS:
        bins = np.stack([_close_gaps(column) for column in bins.T], axis=-1)
    first = int(bins.min())
    width = int(bins.max()) - first + 2  # at least one pair
    bins += np.arange(_ANGLES) * width - first
    votes = np.bincount(bins.ravel(), minlength=_ANGLES * width)
    left = np.ones(len(centers), np.bool_)
    needed = max(_MIN_LINE_CELLS, _MIN_LINE / resolution * min(1.0, _MAX_CELLS / len(cells)))
    for _ in range(_MAX_LINES):
        of_angle = votes.reshape(_ANGLES, width)
        pairs = of_angle[:, :-1] + of_angle[:, 1:]  # lines of _LINE_WIDTH
        k, low = divmod(int(np.argmax(pairs)), width - 1)
        if pairs[k, low] < needed:
            return
        best = k * width + low
        on = left & ((bins[:, k] == best) | (bins[:, k] == best + 1))
        votes -= np.bincount(bins[on].ravel(), minlength=len(votes))
        left &= ~on
        middle = centers[on].mean(axis=0)
        _, _, axes = np.linalg.svd(centers[on] - middle, full_matrices=False)
        yield axes[1], float(middle @ axes[1])


def _close_gaps(numbers: Cells) -> Cells:
    """Numbers (N,) in the same order, with one between those that are not successive."""
    known, of = np.unique(numbers, return_inverse=True)
    return np.asarray(np.cumsum(np.minimum(np.diff(known, prepend=known[:1]), 2))[of])


MIN_BEHIND = 0.3  # m behind the line: nearer end points are noise of the line's own wall
BIN = 0.1  # m along a line
_FRAME = 0.4  # m beside a mirror where there is wall in its plane
MIN_BEAMS = 60
_MAX_WIDENING = 0.4  # m at each end of a mirror
_ON_LINE, _MAX_THICKNESS = 0.07, 0.35  # m from the line to its wall, and to that wall's back
_MIN_FRAME_HITS, _MIN_FILLED = 3, 0.7  # returns in a bin of the frame; share of such bins
_MAX_BESIDE = 0.25  # share of the beams per metre of mirror that see something else beside it
_MAX_SEEN = 0.3  # share of what it shows that beams also end on which do not cross it
# share of the reflected beams that end on surfaces (others show people), and the same of those
# that hardly fit beside, as walls along n do anywhere; less where wall behind proves the rest
_MIN_SHARES, _MIN_SHARES_IF_BACKED = (0.7, 0.6), (0.55, 0.4)
_CONTROL = (0.25, -0.25, 0.4, -0.4)  # m from the mirror, where as many must not fit
_MAX_BLOCKED = 0.2  # share of the reflected beams that would pass through surfaces
_MIN_TRAVEL = 0.7  # m between places from which the mirror was seen


@dataclass(frozen=True)
class Mirror:
    """A mirror n . x = d, from first to last metre along (-n_y, n_x), seen from one side.

    Attributes:
        normal: (2,) unit vector towards the side from which it was seen.
        distance: m, d.
        first, last: m.
    """

    normal: Float
    distance: float
    first: float
    last: float

    def find_crossing(self, origins: Float, ends: Float) -> Bool:
        """(N,) which beams from origins (N, 2) to ends (N, 2) meet it from its front."""
        front, behind = origins @ self.normal - self.distance, self.distance - ends @ self.normal
        crosses = (front > 0.0) & (behind > 0.5 * MIN_BEHIND)
        share = np.divide(front, front + behind, out=np.zeros(len(front)), where=crosses)
        met = origins + share[:, None] * (ends - origins)
        along = met @ tangent_of(self.normal)
        return np.asarray(crosses & (along >= self.first) & (along <= self.last))


class Beams(NamedTuple):
    """N beams with a return, in the map frame.

    Attributes:
        origins, ends: (N, 2) m.
        is_static: (N,) P(c = 1) > 1/2.
        path: (K, 2) positions of the sensors, in order.
    """

    origins: Float
    ends: Float
    is_static: Bool
    path: Float

    def without(self, left_out: Bool) -> "Beams":
        """The others."""
        kept = ~left_out
        return Beams(self.origins[kept], self.ends[kept], self.is_static[kept], self.path)


class CrossingBeams(NamedTuple):
    """N beams that cross a line from its front.

    Attributes:
        origins, ends: (N, 2) m.
        along: (N,) m along the line, where they cross it.
        fit: (N,) whether the end point, reflected at the line, lies on a surface.
    """

    origins: Float
    ends: Float
    along: Float
    fit: Bool

    def select(self, chosen: Bool) -> "CrossingBeams":
        """Some of the beams (N,)."""
        return CrossingBeams._make(column[chosen] for column in self)


def tangent_of(normal: Float) -> Float:
    """(2,) unit vector along a line of unit normal (2,)."""
    return np.array([-normal[1], normal[0]])


def reflect(points: Float, normal: Float, distance: float) -> Float:
    """Points (..., 2) reflected at the line normal . x = distance."""
    return np.asarray(points - 2.0 * (points @ normal - distance)[..., None] * normal)


def check_mirror(
    mirror: Mirror, crossing: CrossingBeams, beams: Beams, surfaces: SurfaceCells
) -> Mirror | None:
    """A piece of a line, as wide as its wall or its frame shows, or None where it is no mirror.

    Args:
        mirror: the piece.
        crossing: all beams that cross its line.
        beams: all beams.
        surfaces: what is static.
    """
    is_within = (crossing.along >= mirror.first) & (crossing.along <= mirror.last)
    within = crossing.select(is_within)
    has_wall_behind = _has_wall_behind(mirror, beams)
    needed = _MIN_SHARES_IF_BACKED if has_wall_behind else _MIN_SHARES
    if not _shows_reflections(mirror, within, beams.path, surfaces, needed):
        return None
    if has_wall_behind:
        return _widen_to_back(mirror, beams)
    is_mirror = (
        _has_edges(within.along, crossing.along[~is_within & ~crossing.fit], mirror)
        and _has_frame(mirror, beams.ends)
        and not _is_seen_without_mirror(mirror, beams, within.ends, surfaces.resolution)
    )
    if not is_mirror:
        return None
    # the frame is wall: nothing else crosses there
    return replace(mirror, first=mirror.first - _FRAME, last=mirror.last + _FRAME)


def _has_wall_behind(mirror: Mirror, beams: Beams) -> bool:
    """True if scans from the other side see a wall right behind the mirror, all along it."""
    hits = _back_hits(mirror, beams, mirror.first, mirror.last)
    return bool(np.count_nonzero(hits >= _MIN_FRAME_HITS) >= _MIN_FILLED * len(hits))


def _widen_to_back(mirror: Mirror, beams: Beams) -> Mirror:
    """The mirror as wide as the wall at its back."""

    def is_wall(start: float) -> bool:
        return bool(_back_hits(mirror, beams, start, start + BIN)[0] >= _MIN_FRAME_HITS)

    first, last = mirror.first, mirror.last
    while last - mirror.last < _MAX_WIDENING and is_wall(last):
        last += BIN
    while mirror.first - first < _MAX_WIDENING and is_wall(first - BIN):
        first -= BIN
    return replace(mirror, first=first, last=last)


def _back_hits(mirror: Mirror, beams: Beams, first: float, last: float) -> Index:
    """(B,) returns from the back of a mirror's wall, in bins from first to last metre."""
    front = beams.ends @ mirror.normal - mirror.distance
    on = (front < 0.5 * _ON_LINE) & (front > -_MAX_THICKNESS)
    on &= beams.origins @ mirror.normal < mirror.distance - _MAX_THICKNESS
    at = beams.ends[on] @ tangent_of(mirror.normal)
    return np.histogram(at, max(1, round((last - first) / BIN)), (first, last))[0]


def _has_frame(mirror: Mirror, ends: Float) -> bool:
    """True if there is wall on both sides; else it may be the axis of a symmetric room."""
    on = ends[np.abs(ends @ mirror.normal - mirror.distance) < _ON_LINE] @ tangent_of(mirror.normal)
    for low, high in ((mirror.first - _FRAME, mirror.first), (mirror.last, mirror.last + _FRAME)):
        hits = np.histogram(on, round(_FRAME / BIN), (low, high))[0]
        if np.count_nonzero(hits >= _MIN_FRAME_HITS) < _MIN_FILLED * len(hits):
            return False
    return True


def _has_edges(through: Float, beside: Float, mirror: Mirror) -> bool:
    """True if few beams that no mirror explains cross the line right beside the mirror.

    Args:
        through: (N,) metres along the line where beams cross the piece.
        beside: (K,) the same of beams beside it that no mirror explains.
        mirror: the piece.
    """
    first, last = mirror.first, mirror.last
    allowed = _MAX_BESIDE * _FRAME * len(through) / (last - first)
    before = np.count_nonzero((beside >= first - _FRAME) & (beside < first))
    after = np.count_nonzero((beside > last) & (beside <= last + _FRAME))
    return bool(max(before, after) <= allowed)


def _is_seen_without_mirror(mirror: Mirror, beams: Beams, ends: Float, resolution: float) -> bool:
    """True if beams that do not cross the mirror see what is behind it as well."""
    others = beams.ends[~mirror.find_crossing(beams.origins, beams.ends)]
    behind = mirror.distance - others @ mirror.normal > MIN_BEHIND
    keys = np.unique(cell_keys(np.floor(others[behind] / resolution).astype(np.int64)))
    return float(np.mean(contains(keys, ends, resolution))) > _MAX_SEEN


def _shows_reflections(
    mirror: Mirror,
    crossing: CrossingBeams,
    path: Float,
    surfaces: SurfaceCells,
    min_shares: tuple[float, float],
) -> bool:
    """True if the end points behind the line, reflected at it, lie on surfaces in free view."""
    normal, distance, fit = mirror.normal, mirror.distance, crossing.fit
    if len(fit) < MIN_BEAMS or np.linalg.norm(np.ptp(crossing.origins, axis=0)) < _MIN_TRAVEL:
        return False
    before = path @ normal - distance  # a robot drives through openings, not through mirrors
    passing = np.flatnonzero(before[:-1] * before[1:] < 0.0)
    gone = path[passing] @ tangent_of(normal)
    if np.any((gone >= mirror.first) & (gone <= mirror.last)):
        return False
    beside = [surfaces.are_near(reflect(crossing.ends, normal, distance + o)) for o in _CONTROL]
    telling = np.sum(beside, axis=0) <= 1
    if np.count_nonzero(fit) < min_shares[0] * len(fit) or np.count_nonzero(telling) < MIN_BEAMS:
        return False
    if np.count_nonzero(fit & telling) < min_shares[1] * np.count_nonzero(telling):
        return False
    return _blocked_share(mirror, crossing, surfaces) <= _MAX_BLOCKED


def _blocked_share(mirror: Mirror, crossing: CrossingBeams, surfaces: SurfaceCells) -> float:
    """Share of the beams that would pass through surfaces if the mirror reflected them."""
    origins, ends = crossing.origins, crossing.ends
    reflected = reflect(ends, mirror.normal, mirror.distance)
    front, behind = origins @ mirror.normal, mirror.distance - ends @ mirror.normal
    share = (front - mirror.distance) / (front - mirror.distance + behind)
    met = origins + share[:, None] * (ends - origins)
    length = np.linalg.norm(reflected - met, axis=1)
    some = np.flatnonzero(length > 1.0)[:: max(1, len(ends) // 500)]
    blocked = np.zeros(len(some), np.bool_)
    for at in np.linspace(0.0, 1.0, 40):
        metres = 0.4 + at * (length[some] - 0.8)
        points = met[some] + (metres / length[some])[:, None] * (reflected[some] - met[some])
        blocked |= surfaces.are_in(points)
    return float(np.mean(blocked)) if len(some) else 0.0
