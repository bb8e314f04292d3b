"""Mirrors: rooms that are not there, recognised as images of what is before the mirror.

A mirror on the line n . x = d shows an end point x' = x - 2 (n . x - d) n of a surface at x. Beams
that cross a piece of a wall line and end behind it are reflections if their end points, folded
back, lie on surfaces, and if the beams, folded back, reach them through free space. Of an opening
both would be chance: folded back at lines beside, as many would fit.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays
from stillmap.core.chunks import iter_beams
from stillmap.core.recording import Recording
from stillmap.mapping.surface_cells import SurfaceCells, cell_keys, contains, iter_lines

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

_MAX_PASSES = 3
_MAX_SAMPLE = 60_000  # beams, of whole scans, that mirrors are searched with
P_REFLECTED = 0.02  # P(c = 1) of reflected beams

_MIN_BEHIND = 0.3  # m behind the line: nearer end points are noise of the line's own wall
_BIN = 0.1  # m along a line
_MIN_WIDTH, _MAX_GAP = 0.6, 0.5  # m of a mirror; m in it that nothing was seen through
_MAX_WIDENING = 0.4  # m at each end of a mirror
_MIN_GAP_SHARE = 0.3  # in such a gap, of what is seen
_FRAME = 0.4  # m beside a mirror where there is wall in its plane
_ON_LINE, _MAX_THICKNESS = 0.07, 0.35  # m from the line to its wall, and to that wall's back
_MIN_FRAME_HITS, _MIN_FILLED = 3, 0.7  # returns in a bin of the frame; share of such bins
_MAX_BESIDE = 0.25  # share of the beams per metre of mirror that see something else beside it
_MAX_SEEN = 0.3  # share of what it shows that beams also end on which do not cross it
_MIN_BEAMS, _MIN_BEAMS_PER_BIN = 60, 3
# share of the beams, folded back, that end on surfaces (others show people), and the same of those
# that hardly fit beside, as walls along n do anywhere; less where wall behind proves the rest
_MIN_SHARES, _MIN_SHARES_IF_BACKED = (0.7, 0.6), (0.55, 0.4)
_MIN_BIN_SHARE = 0.5  # the same of each bin and those beside
# m from a wall line to the mirror on or in the wall
_OFFSETS = (0.0, 0.04, -0.04, 0.08, -0.08, 0.12, -0.12, 0.16, -0.16, 0.2, -0.2)
_MAX_TRIED = 1000  # beams that these are tried with
_CONTROL = (0.25, -0.25, 0.4, -0.4)  # m from the mirror, where as many must not fit
_MAX_BLOCKED = 0.2  # share of the folded beams that would pass through surfaces
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
        crosses = (front > 0.0) & (behind > 0.5 * _MIN_BEHIND)
        share = np.divide(front, front + behind, out=np.zeros(len(front)), where=crosses)
        met = origins + share[:, None] * (ends - origins)
        along = met @ _along(self.normal)
        return np.asarray(crosses & (along >= self.first) & (along <= self.last))


def remove_reflections(
    recording: Recording, poses: Float, p_static: NDArray[np.float32], resolution: float
) -> tuple[Recording, Bool | None]:
    """The recording with the beams that mirrors reflected marked as unusable, and their mask (M,).

    Arguments as of `find_mirrors`. Without mirrors the recording itself, and None.
    """
    reflected = None
    for _ in range(_MAX_PASSES):  # what one mirror shows may hide another
        mirrors = find_mirrors(recording, poses, p_static, resolution)
        if not mirrors:
            break
        more = find_reflections(recording, poses, mirrors)
        reflected = more if reflected is None else reflected | more
        points = arrays.copy(recording.points, recording.scratch)
        hit = arrays.copy(recording.hit, recording.scratch)
        points[more], hit[more] = np.nan, False
        recording = replace(recording, points=points, hit=hit)
    return recording, reflected


def find_mirrors(
    recording: Recording, poses: Float, p_static: NDArray[np.float32], resolution: float
) -> list[Mirror]:
    """The mirrors of a place.

    Args:
        recording: 2D, deskewed, M beams.
        poses: (T, 3, 3) T_map_base.
        p_static: (M,) P(c = 1).
        resolution: edge of a cell, metres.
    """
    beams = _sample_beams(recording, poses, p_static)
    surfaces = SurfaceCells.of(beams.ends, beams.is_static, resolution)
    mirrors: list[Mirror] = []
    for normal, distance in iter_lines(surfaces.cells, resolution):
        for side in (1.0, -1.0):
            found = list(_find_on_line(beams, surfaces, side * normal, side * distance))
            for mirror in found:  # the lines beside would show it again
                beams = beams.without(mirror.find_crossing(beams.origins, beams.ends))
            mirrors += found
    return mirrors


def find_reflections(recording: Recording, poses: Float, mirrors: list[Mirror]) -> Bool:
    """(M,) mask of the beams that mirrors reflected, with or without a return."""
    found = np.zeros(recording.n_beams, np.bool_)
    for _, beams, data in iter_beams(recording, poses):
        scan = np.repeat(np.arange(len(data.T_map_sensor)), np.diff(data.offset))
        T = data.T_map_sensor[scan]
        origins = T[:, :2, 2]
        ends = origins + np.einsum("nij,nj->ni", T[:, :2, :2], data.points.astype(np.float64))
        usable = np.isfinite(ends[:, 0])
        ends[~usable] = origins[~usable]
        for mirror in mirrors:
            found[beams] |= mirror.find_crossing(origins, ends)
    return found


class _Beams(NamedTuple):
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

    def without(self, left_out: Bool) -> "_Beams":
        """The others."""
        kept = ~left_out
        return _Beams(self.origins[kept], self.ends[kept], self.is_static[kept], self.path)


def _sample_beams(recording: Recording, poses: Float, p_static: NDArray[np.float32]) -> _Beams:
    """The returns of every few scans."""
    T_map_sensor = recording.T_map_sensor(poses)
    every = max(1, recording.n_beams // _MAX_SAMPLE)
    sampled = np.zeros(recording.n_beams, np.bool_)
    for scan in range(0, recording.n_scans, every):
        sampled[recording.beams_of(scan)] = True
    beams = np.flatnonzero(sampled & recording.hit)
    origins = T_map_sensor[recording.scans_of(beams), :2, 2]
    return _Beams(
        origins, recording.end_points(beams, poses), p_static[beams] > 0.5, T_map_sensor[:, :2, 2]
    )


def _along(normal: Float) -> Float:
    return np.array([-normal[1], normal[0]])


def _find_on_line(
    beams: _Beams, surfaces: SurfaceCells, normal: Float, distance: float
) -> Iterator[Mirror]:
    """Mirrors on a line, seen from where its normal points to."""
    front, behind = beams.origins @ normal - distance, distance - beams.ends @ normal
    crossing = np.flatnonzero((front > 0.0) & (behind > _MIN_BEHIND))
    if len(crossing) < _MIN_BEAMS:
        return
    origins, ends = beams.origins[crossing], beams.ends[crossing]
    share = front[crossing] / (front + behind)[crossing]
    along = (origins + share[:, None] * (ends - origins)) @ _along(normal)
    some = ends[:: max(1, len(ends) // _MAX_TRIED)]
    counts = [surfaces.are_in(_fold(some, normal, distance + o)).sum() for o in _OFFSETS]
    distance += _OFFSETS[int(np.argmax(counts))]
    fit = surfaces.are_near(_fold(ends, normal, distance))
    for first, last in _find_runs(along, fit):
        within = (along >= first) & (along <= last)
        mirror = Mirror(normal, distance, first, last)
        is_backed = _is_backed(mirror, beams)
        needed = _MIN_SHARES_IF_BACKED if is_backed else _MIN_SHARES
        if not _is_mirror(mirror, origins[within], ends[within], beams.path, surfaces, needed):
            continue
        if is_backed:
            yield _widen_to_back(mirror, beams)
        elif (
            _has_edges(along[within], along[~within & ~fit], first, last)
            and _is_framed(mirror, beams.ends)
            and not _is_seen_otherwise(mirror, beams, ends[within], surfaces.resolution)
        ):  # the frame is wall: nothing else crosses there
            yield replace(mirror, first=first - _FRAME, last=last + _FRAME)


def _is_backed(mirror: Mirror, beams: _Beams) -> bool:
    """Whether beams from behind end right behind a mirror: others cannot have passed there."""
    hits = _back_hits(mirror, beams, mirror.first, mirror.last)
    return bool(np.count_nonzero(hits >= _MIN_FRAME_HITS) >= _MIN_FILLED * len(hits))


def _widen_to_back(mirror: Mirror, beams: _Beams) -> Mirror:
    """The mirror as wide as the wall at its back."""

    def is_wall(start: float) -> bool:
        return bool(_back_hits(mirror, beams, start, start + _BIN)[0] >= _MIN_FRAME_HITS)

    first, last = mirror.first, mirror.last
    while last - mirror.last < _MAX_WIDENING and is_wall(last):
        last += _BIN
    while mirror.first - first < _MAX_WIDENING and is_wall(first - _BIN):
        first -= _BIN
    return replace(mirror, first=first, last=last)


def _back_hits(mirror: Mirror, beams: _Beams, first: float, last: float) -> NDArray[np.intp]:
    """(B,) returns from the back of a mirror's wall, in bins from first to last metre."""
    front = beams.ends @ mirror.normal - mirror.distance
    on = (front < 0.5 * _ON_LINE) & (front > -_MAX_THICKNESS)
    on &= beams.origins @ mirror.normal < mirror.distance - _MAX_THICKNESS
    at = beams.ends[on] @ _along(mirror.normal)
    return np.histogram(at, max(1, round((last - first) / _BIN)), (first, last))[0]


def _is_framed(mirror: Mirror, ends: Float) -> bool:
    """Whether there is wall beside a mirror on both sides; else a room is its halves' image."""
    on = ends[np.abs(ends @ mirror.normal - mirror.distance) < _ON_LINE] @ _along(mirror.normal)
    for low, high in (
        (mirror.first - _FRAME, mirror.first),
        (mirror.last, mirror.last + _FRAME),
    ):
        hits = np.histogram(on, round(_FRAME / _BIN), (low, high))[0]
        if np.count_nonzero(hits >= _MIN_FRAME_HITS) < _MIN_FILLED * len(hits):
            return False
    return True


def _has_edges(through: Float, beside: Float, first: float, last: float) -> bool:
    """Whether few beams see something else right beside a piece of a line.

    Args:
        through: (N,) metres along the line where beams cross the piece.
        beside: (K,) the same of beams beside it that no mirror explains.
        first, last: m, ends of the piece.
    """
    allowed = _MAX_BESIDE * _FRAME * len(through) / (last - first)
    before = np.count_nonzero((beside >= first - _FRAME) & (beside < first))
    after = np.count_nonzero((beside > last) & (beside <= last + _FRAME))
    return bool(max(before, after) <= allowed)


def _is_seen_otherwise(mirror: Mirror, beams: _Beams, ends: Float, resolution: float) -> bool:
    """Whether beams that do not cross a mirror end where those do that cross it."""
    others = beams.ends[~mirror.find_crossing(beams.origins, beams.ends)]
    behind = mirror.distance - others @ mirror.normal > _MIN_BEHIND
    keys = np.unique(cell_keys(np.floor(others[behind] / resolution).astype(np.int64)))
    return float(np.mean(contains(keys, ends, resolution))) > _MAX_SEEN


def _fold(points: Float, normal: Float, distance: float) -> Float:
    """Points (..., 2) reflected at a line."""
    return np.asarray(points - 2.0 * (points @ normal - distance)[..., None] * normal)


def _find_runs(along: Float, fit: Bool) -> list[tuple[float, float]]:
    """Pieces of a line whose crossing beams fit, from first to last metre."""
    low = float(along.min())
    number = ((along - low) / _BIN).astype(np.int64)
    total = np.bincount(number, minlength=1).astype(np.float64)
    fitting = np.bincount(number, weights=fit, minlength=1).astype(np.float64)
    around = np.ones(3)
    n = np.convolve(total, around, "same")
    fitting = np.convolve(fitting, around, "same")
    good = (n >= _MIN_BEAMS_PER_BIN) & (fitting >= _MIN_BIN_SHARE * n)
    runs: list[list[float]] = []
    for k in np.flatnonzero(good).tolist():
        start = low + _BIN * k
        last_bin = round((runs[-1][1] - low) / _BIN) if runs else 0
        gap = slice(last_bin, k)  # what stands before a mirror hides parts of it
        if (
            runs
            and k - last_bin <= _MAX_GAP / _BIN
            and (fitting[gap].sum() >= _MIN_GAP_SHARE * n[gap].sum())
        ):
            runs[-1][1] = start + _BIN
        else:
            runs.append([start, start + _BIN])
    return [(a, b) for a, b in runs if b - a >= _MIN_WIDTH]


def _is_mirror(
    mirror: Mirror,
    origins: Float,
    ends: Float,
    path: Float,
    surfaces: SurfaceCells,
    min_shares: tuple[float, float],
) -> bool:
    """Whether beams that cross a piece of a line are what a mirror there would show."""
    normal, distance = mirror.normal, mirror.distance
    if len(ends) < _MIN_BEAMS or np.linalg.norm(np.ptp(origins, axis=0)) < _MIN_TRAVEL:
        return False
    before = path @ normal - distance  # a robot drives through openings, not through mirrors
    passing = np.flatnonzero(before[:-1] * before[1:] < 0.0)
    gone = path[passing] @ _along(normal)
    if np.any((gone >= mirror.first) & (gone <= mirror.last)):
        return False
    fit = surfaces.are_near(_fold(ends, normal, distance))
    beside = [surfaces.are_near(_fold(ends, normal, distance + o)) for o in _CONTROL]
    telling = np.sum(beside, axis=0) <= 1
    if np.count_nonzero(fit) < min_shares[0] * len(fit) or np.count_nonzero(telling) < _MIN_BEAMS:
        return False
    if np.count_nonzero(fit & telling) < min_shares[1] * np.count_nonzero(telling):
        return False
    return _blocked_share(mirror, origins, ends, surfaces) <= _MAX_BLOCKED


def _blocked_share(mirror: Mirror, origins: Float, ends: Float, surfaces: SurfaceCells) -> float:
    """Share of the beams that would pass through surfaces if the mirror reflected them."""
    folded = _fold(ends, mirror.normal, mirror.distance)
    front, behind = origins @ mirror.normal, mirror.distance - ends @ mirror.normal
    share = (front - mirror.distance) / (front - mirror.distance + behind)
    met = origins + share[:, None] * (ends - origins)
    length = np.linalg.norm(folded - met, axis=1)
    some = np.flatnonzero(length > 1.0)[:: max(1, len(ends) // 500)]
    blocked = np.zeros(len(some), np.bool_)
    for at in np.linspace(0.0, 1.0, 40):
        metres = 0.4 + at * (length[some] - 0.8)
        points = met[some] + (metres / length[some])[:, None] * (folded[some] - met[some])
        blocked |= surfaces.are_in(points)
    return float(np.mean(blocked)) if len(some) else 0.0
