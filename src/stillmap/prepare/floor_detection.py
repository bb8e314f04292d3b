"""Floor detection: a robot that pitches on rough ground shows its planar laser the floor.

A laser at height h whose scan plane is tilted by p about a horizontal axis sees a level floor at
range r in direction a where 1 / r = sin(p) / h cos(a - a0): a straight line across the direction
a0 of the tilt. So does a wall, but floor comes and goes within a second. A line is floor if scans
shortly before and scans shortly after looked past it, if the rest of the scan agrees with them,
and if nothing in the scan lies behind it, since floor has no end. People and cars pass the first
two tests, and fail the others; doing so is harmless, since they are no part of the map either.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.array_types import Bool, Float, Index, Int64
from stillmap.core.recording import Recording

# s, from a scan to those that it is compared with: bumps last .3 to 1.5 s, so that some lie outside
_OFFSETS = (0.4, 0.8, 1.2, 1.8)
_NEAREST = 2  # scans before and after that are compared in sparse recordings, however long ago
_MAX_LATE = 0.6  # s, from one of these times to the scan nearest to it
_MAX_TRAVEL, _MAX_TURN = 2.5, 1.0  # m, rad between compared scans: the same view, known well enough
_LINE_MARGIN, _LINE_MARGIN_SHARE = 0.04, 0.02  # m plus share of the range: noise, uneven floor
_COARSE_BEAMS = 48  # beams per scan that are compared first
_MIN_COARSE, _MIN_BEAMS = 3, 6  # beams that others looked past
_MIN_SPAN, _MIN_LENGTH = 0.2, 1.0  # rad, m of the line: longer than a person
_MIN_DISTANCE = 1.0  # m from sensor to line; a laser .1 m high would pitch by 6 degrees
# share of the line's beams that others looked past, at the rest is wall: less if many other beams
# show that the poses are right
_MIN_PAST, _MIN_PAST_AMONG_OTHERS = 0.8, 0.6
_MIN_VOTES = 0.5  # share of the scans compared: odometry that jumps misleads only some
_MIN_KNOWN = 0.4  # share of the line's beams of which these scans must know
_MIN_AGREEMENT = 0.7  # share of the other beams that agree with these scans
_MIN_OTHERS, _MANY_OTHERS = 10, 40  # other beams from which on their agreement counts, and is proof
_MIN_FILLED = 0.5  # share of the returns between the ends of the line that are on it
_MAX_BEYOND = 0.05  # share of the returns that lie behind the line or its extension
_MAX_FLOOR_RANGE = 60.0  # m; farther away even a level scan plane may meet the floor
_CHUNK_BEAMS = 1 << 17

PASSED, AGREED, SHORTER = 1, 2, 3  # how another scan's beam relates to an end point; 0: unknown
_MARGIN, _MARGIN_SHARE = 0.2, 0.04  # m plus share of the range; odometry over 2 s is better


@dataclass(frozen=True, eq=False)
class ScanViews:
    """S scans of one sensor with up to n beams, as lists of beams and as polar profiles.

    Attributes:
        points: (S, n, 2) end points in the sensor frame, m; NaN: unusable, or no such beam.
        hit: (S, n).
        ranges, bearings: (S, n) of them.
        nearest, farthest: (S, B) range in each of B sectors and the two beside it; NaN: unknown.
        T_map_sensor: (S, 3, 3).
    """

    points: Float
    hit: Bool
    ranges: Float
    bearings: Float
    nearest: Float
    farthest: Float
    T_map_sensor: Float

    @classmethod
    def read(cls, recording: Recording, scans: Index, T_map_sensor: Float) -> "ScanViews":
        """Reads some scans of a recording."""
        counts = np.diff(recording.offset)[scans]
        n = int(counts.max())
        beam = np.minimum(recording.offset[scans][:, None] + np.arange(n), recording.n_beams - 1)
        points = recording.points[beam].astype(np.float64)
        points[np.arange(n) >= counts[:, None]] = np.nan
        ranges = np.hypot(points[..., 0], points[..., 1])
        hit = recording.hit[beam] & np.isfinite(ranges)
        bearings = np.arctan2(points[..., 1], points[..., 0])
        spacing = np.diff(np.sort(bearings, axis=1), axis=1)
        usual = float(np.nanmedian(spacing)) if np.isfinite(spacing).any() else 1.0
        sectors = int(np.clip(2.0 * np.pi / max(usual, 1e-4), 8, 4096))
        profiles = _polar_profiles(ranges, bearings, sectors)
        return cls(points, hit, ranges, bearings, *profiles, T_map_sensor[scans])

    def compare(self, scan: Index, beams: Index, reference: Index) -> NDArray[np.int8]:
        """(K, R, N) how beams of R other scans relate to the end points of N beams of K scans.

        Args:
            scan: (K,) the scans.
            beams: (N,) beams of all of them.
            reference: (K, R) scans to compare with; -1: none, nothing is known.
        """
        T = se2.inverse(self.T_map_sensor[reference]) @ self.T_map_sensor[scan][:, None]
        c, s, tx, ty = (T[..., i, j, None] for i, j in ((0, 0), (1, 0), (0, 2), (1, 2)))
        x, y = np.moveaxis(self.points[scan[:, None], beams], -1, 0)[:, :, None]
        u, v = c * x - s * y + tx, s * x + c * y + ty
        r, sectors = np.hypot(u, v), self.nearest.shape[1]
        with np.errstate(invalid="ignore"):  # NaN becomes some sector
            sector = (np.arctan2(v, u) * (sectors / (2.0 * np.pi)) + sectors).astype(np.int64)
            cell = reference[:, :, None] * sectors + sector % sectors
            near, far = self.nearest.take(cell), self.farthest.take(cell)
            margin = _MARGIN + _MARGIN_SHARE * r
            relation = np.where(far < r - margin, np.int8(SHORTER), np.int8(AGREED))
            relation[near > r + margin] = PASSED
            relation[~(near > 0.0) | ~np.isfinite(r) | (reference < 0)[:, :, None]] = 0
        return relation


def _polar_profiles(ranges: Float, bearings: Float, sectors: int) -> tuple[Float, Float]:
    """(S, B) least and greatest range of the usable beams in each sector and those beside it."""
    scan, beam = np.nonzero(np.isfinite(ranges))
    turns = bearings[scan, beam] / (2.0 * np.pi) + 1.0
    cell = scan * sectors + (turns * sectors).astype(np.int64) % sectors
    near = np.full(len(ranges) * sectors, np.inf)
    far = np.zeros(len(ranges) * sectors)
    np.minimum.at(near, cell, ranges[scan, beam])
    np.maximum.at(far, cell, ranges[scan, beam])
    least, most = near.reshape(-1, sectors), far.reshape(-1, sectors)
    least = np.minimum(least, np.minimum(np.roll(least, 1, axis=1), np.roll(least, -1, axis=1)))
    most = np.maximum(most, np.maximum(np.roll(most, 1, axis=1), np.roll(most, -1, axis=1)))
    return np.where(np.isfinite(least), least, np.nan), np.where(most > 0.0, most, np.nan)


def find_floor_returns(recording: Recording, poses: Float) -> Bool:
    """(M,) mask of returns from the floor, in scans of a planar laser that a bump has tilted.

    Args:
        recording: 2D, T scans with M beams.
        poses: (T, 3, 3) of the base in a common frame; they have to be right over a few seconds
            only, such as odometry.
    """
    mask = np.zeros(recording.n_beams, np.bool_)
    T_map_sensor = recording.T_map_sensor(poses)
    seconds = np.asarray(1e-9 * (recording.stamp_ns - recording.stamp_ns[:1]), np.float64)
    for sensor in range(len(recording.T_base_sensor)):
        scans = np.flatnonzero(recording.sensor == sensor)
        if len(scans) < 3:
            continue
        before = _reference_scans(seconds[scans], T_map_sensor[scans], -1)
        after = _reference_scans(seconds[scans], T_map_sensor[scans], 1)
        references = np.concatenate([before, after], axis=1)
        widest = int(np.diff(recording.offset)[scans].max())
        step = max(1, _CHUNK_BEAMS // max(widest, 1))
        for first in range(0, len(scans), step):
            own = np.arange(first, min(first + step, len(scans)))
            _find_in_chunk(recording, scans, T_map_sensor, references, own, mask)
    return mask


def _reference_scans(seconds: Float, T_map_sensor: Float, side: int) -> Int64:
    """(T, R) scans of one sensor that each is compared with, before (-1) or after (1); -1: none."""
    T = len(seconds)
    number, columns = np.arange(T), []
    for k, offset in enumerate(_OFFSETS, 1):
        wanted = seconds + side * offset
        late = np.clip(np.searchsorted(seconds, wanted), 1, T - 1)
        nearer = np.abs(seconds[late - 1] - wanted) <= np.abs(seconds[late] - wanted)
        scan = np.where(nearer, late - 1, late)
        late_by = np.abs(seconds[scan] - wanted)
        columns.append(np.where(late_by <= _MAX_LATE, scan, number + side * min(k, _NEAREST)))
    chosen = np.stack(columns, axis=1)
    chosen[(chosen < 0) | (chosen >= T) | (side * (chosen - number[:, None]) <= 0)] = -1
    for k in range(1, chosen.shape[1]):  # each scan once
        chosen[(chosen[:, k : k + 1] == chosen[:, :k]).any(axis=1), k] = -1
    x, y, theta = se2.parameters(T_map_sensor).T
    travel = np.hypot(x[chosen] - x[:, None], y[chosen] - y[:, None])
    turn = np.abs(se2.wrap(theta[chosen] - theta[:, None]))
    chosen[(travel > _MAX_TRAVEL) | (turn > _MAX_TURN)] = -1
    return chosen


def _find_in_chunk(
    recording: Recording,
    scans: Index,
    T_map_sensor: Float,
    references: Int64,
    own: Index,
    mask: Bool,
) -> None:
    """Marks floor returns of some scans of a sensor.

    Args:
        recording: 2D.
        scans: (S,) of the sensor.
        T_map_sensor: (T, 3, 3) of all scans.
        references: (S, 2R) of these scans before and after each.
        own: consecutive ones of the scans.
        mask: (M,) to add to.
    """
    use = references[own]
    first = min(int(own[0]), int(use.min(where=use >= 0, initial=own[0])))
    last = max(int(own[-1]), int(use.max()))
    views = ScanViews.read(recording, scans[first : last + 1], T_map_sensor)
    own, references = own - first, np.where(use >= 0, use - first, -1)
    for k in _select_scans(views, own, references).tolist():
        floor = _find_in_scan(views, int(own[k]), references[k])
        if floor is not None:
            beams = recording.beams_of(int(scans[first + own[k]]))
            mask[beams][floor[: beams.stop - beams.start]] = True


def _select_scans(views: ScanViews, own: Index, references: Int64) -> Index:
    """Those of the scans in which some of every few beams end where others looked past."""
    beams = _coarse_beams(views)
    past = _is_passed(views.compare(own, beams, references)) & views.hit[own][:, beams]
    return np.flatnonzero(past.sum(axis=1) >= _MIN_COARSE)


def _coarse_beams(views: ScanViews) -> Index:
    """Every few beams."""
    n = views.points.shape[1]
    return np.arange(0, n, max(1, n // _COARSE_BEAMS))


def _is_passed(relation: NDArray[np.int8]) -> Bool:
    """(K, N) whether a scan before and a scan after looked past each end point."""
    before, after = np.split(relation == PASSED, 2, axis=1)
    return np.asarray(before.any(axis=1) & after.any(axis=1))


def _find_in_scan(views: ScanViews, scan: int, references: Int64) -> Bool | None:
    """(n,) mask of the floor returns of a scan; None: there are none."""
    beams = np.flatnonzero(views.hit[scan])
    relation = views.compare(np.array([scan]), beams, references[None])
    ends = _EndPoints(views.points[scan, beams], views.ranges[scan, beams])
    line = _fit_line(ends, _is_passed(relation)[0])
    if line is None:
        return None
    on = ends.on_line(line)
    if not (
        _is_like_floor(ends, line, on)
        and _came_and_went(relation[0], on)
        and _agree_with_one_another(views, *np.split(references, 2))
    ):
        return None
    floor = np.zeros(views.hit.shape[1], np.bool_)
    floor[beams[on]] = True
    return floor


def _reciprocal(across: Float) -> Float:
    """1 / x; inf where x is not positive, or hardly."""
    out = np.full(across.shape, np.inf)
    np.divide(1.0, across, out=out, where=across > 1e-3)
    return out


class _EndPoints(NamedTuple):
    """End points (n, 2) of the hits of a scan in the sensor frame, and their ranges (n,)."""

    points: Float
    ranges: Float

    def line_range(self, line: Float) -> Float:
        """(n,) range at which each beam meets the line l . x = 1; inf: it does not."""
        across = self.points @ line / self.ranges
        return _reciprocal(across)

    def on_line(self, line: Float) -> Bool:
        """(n,) whether they lie on a line, along their beams."""
        margin = _LINE_MARGIN + _LINE_MARGIN_SHARE * self.ranges
        return np.asarray(np.abs(self.line_range(line) - self.ranges) < margin)


def _fit_line(ends: _EndPoints, candidates: Bool) -> Float | None:
    """(2,) the line l . x = 1 through most of the candidates; None: there is none.

    Of the lines through some pairs of candidates the best is fitted again to what lies on it.
    """
    chosen = np.flatnonzero(candidates)
    if len(chosen) < _MIN_BEAMS:
        return None
    bearing = np.arctan2(ends.points[chosen, 1], ends.points[chosen, 0])
    chosen = chosen[np.argsort(bearing, kind="stable")]
    some = _EndPoints(ends.points[chosen], ends.ranges[chosen])
    lines = _lines_through_pairs(some.points)
    if not len(lines):
        return None
    across = lines @ (some.points / some.ranges[:, None]).T
    met = _reciprocal(across)
    margin = _LINE_MARGIN + _LINE_MARGIN_SHARE * some.ranges
    line = lines[int(np.argmax((np.abs(met - some.ranges) < margin).sum(axis=1)))]
    for _ in range(2):
        on = some.on_line(line)
        if np.count_nonzero(on) < _MIN_BEAMS:
            return None
        # l . x = 1 with errors of the range, which change it by l . x / r
        A = some.points[on] * some.ranges[on, None]
        line = np.linalg.lstsq(A, some.ranges[on], rcond=None)[0]
    return np.asarray(line)


def _lines_through_pairs(points: Float) -> Float:
    """(H, 2) lines l . x = 1 through pairs of n points far apart in their order."""
    n, pairs = len(points), []
    for gap in sorted({max(2, n * k // 6) for k in range(1, 5)}):
        first = np.arange(0, n - gap, max(1, (n - gap) // 12))
        pairs.append(np.stack([first, first + gap], axis=1))
    a, b = np.moveaxis(points[np.concatenate(pairs)], 1, 0)
    area = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    crosses = np.abs(area) > 1e-2  # else the line runs through the sensor
    a, b, area = a[crosses], b[crosses], area[crosses]
    lines = np.stack([b[:, 1] - a[:, 1], a[:, 0] - b[:, 0]], axis=1) / area[:, None]
    return np.asarray(lines)


def _is_like_floor(ends: _EndPoints, line: Float, on: Bool) -> bool:
    """True if a line is long and gapless, far enough away, and no end point lies behind it."""
    if np.count_nonzero(on) < _MIN_BEAMS or float(np.linalg.norm(line)) * _MIN_DISTANCE > 1.0:
        return False
    # directions seen from the foot of the perpendicular: no jump within half a turn
    u, v = ends.points @ line, ends.points @ np.array([-line[1], line[0]])
    bearing, along = np.arctan2(v, u), v / np.linalg.norm(line)
    low, high = bearing[on].min(), bearing[on].max()
    if high - low < _MIN_SPAN or np.ptp(along[on]) < _MIN_LENGTH:
        return False
    if np.count_nonzero(on) < _MIN_FILLED * np.count_nonzero((bearing >= low) & (bearing <= high)):
        return False
    met = ends.line_range(line)
    margin = 2.0 * (_LINE_MARGIN + _LINE_MARGIN_SHARE * np.minimum(met, ends.ranges))
    n_beyond, n_met = (ends.ranges > met + margin).sum(), (met < _MAX_FLOOR_RANGE).sum()
    return bool(n_beyond <= _MAX_BEYOND * n_met)


def _came_and_went(relation: NDArray[np.int8], on: Bool) -> bool:
    """True if scans before and scans after looked past the line, and enough of them altogether.

    Only scans count that agree with the rest of this one.
    """
    line, others = relation[:, on], relation[:, ~on]
    n_others = (others > 0).sum(axis=1)
    agreement = (others == AGREED).sum(axis=1) >= _MIN_AGREEMENT * n_others
    fit = agreement | (n_others < _MIN_OTHERS)
    is_proven = np.median(n_others[n_others > 0]) >= _MANY_OTHERS if n_others.any() else False
    min_past = _MIN_PAST_AMONG_OTHERS if is_proven else _MIN_PAST
    for side in np.split(np.where(fit[:, None], line, 0), 2):
        passed = (side == PASSED).any(axis=0)
        known = passed | (side == AGREED).any(axis=0)
        n_passed, n_known = np.count_nonzero(passed), np.count_nonzero(known)
        if n_known < max(_MIN_BEAMS - 1, _MIN_KNOWN * len(known)) or n_passed < min_past * n_known:
            return False
    n_passed, n_agreed = (line == PASSED).sum(axis=1), (line == AGREED).sum(axis=1)
    known = fit & (n_passed + n_agreed >= _MIN_KNOWN * line.shape[1])
    votes = n_passed[known] > min_past * (n_passed + n_agreed)[known]
    return bool(np.count_nonzero(votes) >= _MIN_VOTES * len(votes))


def _agree_with_one_another(views: ScanViews, before: Int64, after: Int64) -> bool:
    """True if one of the scans before agrees with one of those after: odometry did not jump."""
    before, beams = before[before >= 0], _coarse_beams(views)
    relation = views.compare(before, beams, np.tile(after, (len(before), 1)))
    relation[~np.broadcast_to(views.hit[before][:, None, beams], relation.shape)] = 0
    known, agreed = (relation > 0).sum(axis=2), (relation == AGREED).sum(axis=2)
    return bool(np.any((known >= _MIN_BEAMS) & (agreed >= _MIN_AGREEMENT * known)))
