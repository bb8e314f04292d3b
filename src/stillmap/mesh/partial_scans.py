"""Partial scans of moving objects: their surfaces, and their alignment in the object's frame.

Over a second a car moves evenly, so six parameters of its motion, common to all partial scans,
correct the track: the error of its velocity, turn rate and acceleration. Where scans do not
constrain them, as along a side without ends, the track's values hold.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.spatial import Delaunay, QhullError, cKDTree

from stillmap.core.array_types import Bool, Float, Index, Int32
from stillmap.mesh.inputs import ObjectFrame
from stillmap.mesh.range_image import Patch
from stillmap.mesh.returns import SPACING, DynamicReturns, grow_segment
from stillmap.mesh.triangle_mesh import Mesh, remove_small_components
from stillmap.mesh.triangulation import SMOOTHING_ROUNDS, vertex_normals

MIN_COMPONENT_AREA = 0.005  # m2: smaller components of an object's surface are dropped
_MIN_COSINE = 0.2  # from an object's center, up to which points are in one perspective image
_PASS_MARGIN = 0.25  # m behind an object from which on a beam has passed it
_MAX_STEEPNESS = 8.0  # length along the line of sight over length across
_SMOOTHING_KEPT = 0.5  # share of its range that a beam keeps in a round
_MAX_RANGE_STEP = 0.08  # m between neighbors that are smoothed together
_MAX_SPACING_RATIO = 2.5  # edge over median edge of an object's surface
_MAX_EDGE = 0.6  # m, likewise
_CONTEXT = 0.03  # s around a return in which a scan sees the rest of a car
_MIN_TRACK_SHARE = 0.1  # of a cluster that a track owns: else another one tracks it
_MAX_RANGE = 1000.0  # m, end of beams without a return
_CONE_MARGIN = 0.05  # rad around an object, of beams that pass beside it


class PartialScan(NamedTuple):
    """One observation of an object: n beams near in time, towards it.

    Attributes:
        points: (n, 3) metres in its frame, end points.
        origin: (n, 3) metres, sensor positions.
        own: (n,) whether a beam ended on it.
        span: s, from the first to the last.
    """

    points: Float
    origin: Float
    own: Bool
    span: tuple[float, float]


def extract_partial_scan(
    own: Index, span: tuple[float, float], frame: ObjectFrame, fast: bool, returns: DynamicReturns
) -> PartialScan | None:
    """The beams towards an object in an interval; None where most belong to another track.

    Args:
        own: numbers within `returns` of the object's returns, rising.
        span: s, start and end.
        frame: of the object.
        fast: whether all connected dynamic returns are its own.
        returns: the dynamic returns.
    """
    inputs, around = returns.inputs, _CONTEXT if fast else 0.0
    first, last = span[0] - around, span[1] + around
    deskewed = inputs.deskewed
    beams, seconds = inputs.beams_within(first, last)
    origin = inputs.T_map_sensor[deskewed.scans_of(beams), :3, 3]
    mine = within_time(own, returns.seconds, first, last)
    if fast:
        there = returns.in_beam_range(int(beams[0]), int(beams[-1]) + 1)
        every = within_time(np.arange(there.start, there.stop), returns.seconds, first, last)
        sensor = frame.to_object(seconds[:1], origin[:1])[0]
        whole = grow_segment(mine, every, frame, sensor, returns)
        if not len(whole) or len(mine) < _MIN_TRACK_SHARE * len(whole):
            return None
        mine = whole
        span = float(returns.seconds[mine].min()), float(returns.seconds[mine].max())
    is_own = np.isin(beams, returns.beam[mine], assume_unique=True)
    ends = deskewed.end_points(beams, inputs.poses)
    along, towards = ends - origin, ends[is_own].mean(axis=0) - origin
    with np.errstate(invalid="ignore", divide="ignore"):
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        cosine = (along * towards).sum(axis=1) / np.linalg.norm(towards, axis=1)
    widest = np.arccos(np.clip(cosine[is_own].min(), -1.0, 1.0)) + _CONE_MARGIN
    near = np.flatnonzero(cosine >= np.cos(min(float(widest), np.pi)))
    ends = np.where(deskewed.hit[beams][:, None], ends, origin + _MAX_RANGE * along)[near]
    points, origin = (frame.to_object(seconds[near], some) for some in (ends, origin[near]))
    return PartialScan(points, origin, is_own[near], span)


def within_time(some: Index, seconds: Float, first: float, last: float) -> Index:
    """The numbers (n,) whose times lie in an interval."""
    return some[(seconds[some] >= first) & (seconds[some] <= last)]


def triangulate_partial_scan(scan: PartialScan, rigid: bool, max_depth: float) -> Mesh:
    """The surface of a partial scan in the object's frame, triangulated as seen by the sensor.

    Beams that passed the object are corners of the triangulation, so that none goes through it.

    Args:
        scan: the beams.
        rigid: whether the object keeps its shape, as cars do: their sides are seen at grazing
            incidence.
        max_depth: metres along the line of sight between beams on the side of a rigid object.
    """
    points, own = scan.points, scan.own
    if np.count_nonzero(own) < 3:
        return Mesh.empty()
    sensor, center = scan.origin[own].mean(axis=0), points[own].mean(axis=0)
    away = np.linalg.norm(points - sensor, axis=1)
    passed = ~own & (away > away[own].max() + _PASS_MARGIN)
    # where these passed the object, as each beam has its own origin
    along, depth = points - scan.origin, np.linalg.norm(center - scan.origin, axis=1)
    length = np.where(own, depth, np.linalg.norm(along, axis=1))
    by = np.where(own[:, None], points, scan.origin + along * (depth / length)[:, None])
    plane, ahead = _project_perspective(sensor, center, by)
    some = np.flatnonzero(ahead & (own | passed))
    try:
        faces = some[Delaunay(plane[some]).simplices]
    except (QhullError, ValueError):  # too few, or all in one line
        return Mesh.empty()
    faces = faces[own[faces].all(axis=1)]
    if not len(faces):
        return Mesh.empty()
    spans = points[faces] - points[np.roll(faces, 1, axis=1)]
    edges = np.linalg.norm(spans, axis=2)
    if rigid:
        limit = max(_MAX_EDGE, SPACING * float(np.median(away[own])))
        sight = points[faces].mean(axis=1) - sensor
        kept = _is_grazing(spans, edges, sight, limit, max_depth)
    else:
        limit = min(_MAX_SPACING_RATIO * float(np.median(edges)), _MAX_EDGE)
        kept = np.zeros(len(faces), np.bool_)
    mesh = Mesh(points, faces.astype(np.int32)).select(kept | (edges.max(axis=1) <= limit))
    mesh = Mesh(_smooth_ranges(mesh.vertices, mesh.faces, sensor), mesh.faces)
    return remove_small_components(mesh, MIN_COMPONENT_AREA)


def _is_grazing(spans: Float, edges: Float, sight: Float, limit: float, max_depth: float) -> Bool:
    """(m,) whether triangles are short across the line of sight, and long only along it."""
    sight = sight / np.linalg.norm(sight, axis=1, keepdims=True)
    deep = np.abs(np.einsum("nki,ni->nk", spans, sight))
    across = np.sqrt(np.maximum(edges**2 - deep**2, 0.0)).max(axis=1)
    max_depths = np.minimum(max_depth, _MAX_STEEPNESS * across)
    return np.asarray((across <= limit) & (deep.max(axis=1) <= max_depths))


def _project_perspective(sensor: Float, center: Float, points: Float) -> tuple[Float, Bool]:
    """(n, 2) image coordinates of points as seen from the sensor towards `center`, and whether (n,)
    they are in front; counter-clockwise in the image is so as seen from the sensor."""
    towards = (center - sensor) / max(float(np.linalg.norm(center - sensor)), 1e-9)
    across = np.linalg.svd(towards[None])[2][1]
    off = points - sensor
    depth = off @ towards
    with np.errstate(invalid="ignore", divide="ignore"):
        ahead = depth > _MIN_COSINE * np.linalg.norm(off, axis=1)
        sides = np.column_stack([across, np.cross(across, towards)])
        return (off @ sides) / depth[:, None], ahead


def _smooth_ranges(points: Float, faces: Int32, sensor: Float) -> Float:
    """(n, 3) points, their ranges averaged with those of neighbors, but not across steps."""
    off = points - sensor
    length = np.linalg.norm(off, axis=1)
    sight = off / length[:, None]
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    one, other = np.unique(pairs, axis=0).T
    for _ in range(SMOOTHING_ROUNDS):
        step = length[other] - length[one]
        near = np.abs(step) <= _MAX_RANGE_STEP
        total = np.bincount(one[near], step[near], len(points))
        total -= np.bincount(other[near], step[near], len(points))
        count = np.bincount(np.concatenate([one[near], other[near]]), minlength=len(points))
        length = length + (1.0 - _SMOOTHING_KEPT) * total / np.maximum(count, 1)
    return np.asarray(sensor + length[:, None] * sight)


_COARSE_SPEEDS = (0.0, *(s * k for k in (1.0, 2.0, 3.0, 4.0, 5.0, 6.0) for s in (-1.0, 1.0)))  # m/s
_FINE_SPEEDS = (0.0, *(k * s / 10.0 for k in range(1, 11) for s in (-1.0, 1.0)))  # m/s
_SPEED_PENALTY = 0.002  # m per m/s of the coarse search: the track's value wins ties
_SEARCH_POINTS = 500  # of a partial scan in the search over speeds
_MAX_DISTANCE = 0.3  # m at which a point counts as an outlier there
_SEARCH_ROUNDS = 2  # of refinement for each speed

# standard deviations of the motion around the track's, and around that of the speed search
_TRACK_STD = (0.7, 0.4, 0.2, 0.2, 2.0, 1.0)
_SEARCHED_STD = (0.1, 0.4, 0.2, 0.2, 2.0, 1.0)
_POINT_STD = 0.03  # m, of points from a surface
_RADII = (0.6, 0.3, 0.15)  # m, of correspondences, from stage to stage
_SPANS = (0.4, 0.7, 1.0)  # share of the time offsets that take part, likewise
_ROUNDS = 5  # Gauss-Newton steps per stage
_POINTS = 2000  # of a partial scan, at most
_MIN_POINTS = 20
_INDEPENDENT_POINTS = 100.0  # of a partial scan: errors of neighbors are correlated
_MIN_NORMAL_COSINE = 0.5  # between normals of corresponding points


@dataclass(frozen=True, eq=False)
class PartialSurface:
    """The surface of a partial scan, in the object's frame by its track.

    Attributes:
        mesh: the surface.
        normals: (V, 3) unit normals of its vertices, towards the sensor.
        sensor: (3,) sensor position.
        time_offset: s after the time at which the frame is known.
    """

    mesh: Mesh
    normals: Float
    sensor: Float
    time_offset: float

    @classmethod
    def from_mesh(cls, mesh: Mesh, sensor: Float, time_offset: float) -> "PartialSurface":
        """With area-weighted vertex normals."""
        spans = (mesh.normals() * mesh.areas()[:, None]).T
        normals = vertex_normals(spans, mesh.faces, len(mesh.vertices), 0).T
        return cls(mesh, np.ascontiguousarray(normals), sensor, time_offset)

    @cached_property
    def tree(self) -> "cKDTree[None]":
        """The vertices, for searches."""
        return cKDTree(self.mesh.vertices)

    def sample(self, most: int) -> "PartialSurface":
        """About `most` of the vertices, without faces."""
        every = max(1, len(self.mesh.vertices) // most)
        points = Mesh(self.mesh.vertices[::every], self.mesh.faces[:0])
        return replace(self, mesh=points, normals=self.normals[::every])

    def transform(self, motion: Float) -> "PartialSurface":
        """The surface corrected by a motion (6,) relative to the track."""
        R, t = motion_transform(motion, self.time_offset)
        mesh = Mesh(self.mesh.vertices @ R.T + t, self.mesh.faces)
        return replace(self, mesh=mesh, normals=self.normals @ R.T, sensor=R @ self.sensor + t)

    def to_patch(self) -> Patch:
        """The surface as input of TSDF integration."""
        points = self.mesh.vertices
        origin = np.tile(self.sensor, (len(points), 1))
        standoff = ((origin - points) * self.normals).sum(axis=1)
        return Patch(points, self.mesh.faces, np.arange(len(points)), origin, standoff)


def motion_transform(motion: Float, time_offset: float) -> tuple[Float, Float]:
    """(3, 3) and (3,) metres: correction of a partial scan at a time offset in seconds.

    Args:
        motion: (6,) metres per second ahead, to the left and up, rad per second to the left, metres
            per square second ahead and to the left.
        time_offset: s.
    """
    turn = motion[3] * time_offset
    c, s = np.cos(turn), np.sin(turn)
    t = motion[:3] * time_offset
    t[:2] += 0.5 * motion[4:] * time_offset**2
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), t


def register_surfaces(surfaces: Sequence[PartialSurface], best: int) -> Float:
    """(6,) the object's motion relative to its track, see `motion_transform`.

    A search over the forward speed point to point, then Gauss-Newton point to plane against the
    best partial surface, from the surfaces beside it to those far from it.
    """
    known = surfaces[best]
    motion = np.zeros(6)
    if len(known.mesh.vertices) < _MIN_POINTS:
        return motion
    some, few = ([one.sample(n) for one in surfaces] for n in (_POINTS, _SEARCH_POINTS))
    beside = [few[k] for k in (best - 1, best + 1) if 0 <= k < len(surfaces)]
    motion = _search_speed(beside, known, motion, _COARSE_SPEEDS, _SPEED_PENALTY)
    prior = motion * np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])  # the rest is better from the track
    others = [k for k in range(len(surfaces)) if k != best]
    farthest = max(abs(one.time_offset) for one in surfaces)
    for part, radius in zip(_SPANS, _RADII, strict=True):
        near = [some[k] for k in others if abs(some[k].time_offset) <= part * farthest + 1e-9]
        motion = _refine(near, known, motion, prior, _TRACK_STD, radius, _ROUNDS)
    motion = _search_speed([few[k] for k in others], known, motion, _FINE_SPEEDS, 0.0)
    far = [some[k] for k in others]
    return _refine(far, known, motion, motion, _SEARCHED_STD, _RADII[-1], _ROUNDS)


def _search_speed(
    surfaces: Sequence[PartialSurface],
    known: PartialSurface,
    motion: Float,
    speeds: tuple[float, ...],
    penalty: float,
) -> Float:
    """The motion (6,) with another forward speed, if surfaces lie nearer to the best one by that.

    Point to point, so that the ends of a car count, and not its sides only. The track of a part of
    a car may be wrong by half its velocity. For each speed the rest of the motion is refined first:
    along a side that is askew, a motion ahead is nearly as good as one to the left.

    Args:
        surfaces: the others.
        known: the best one.
        motion: initial.
        speeds: m/s that are added, 0 the first of them.
        penalty: m per m/s added.
    """
    found, cost = list[Float](), list[float]()
    for speed in speeds:
        prior = motion + np.array([speed, 0.0, 0.0, 0.0, 0.0, 0.0])
        tried = _refine(surfaces, known, prior, prior, _SEARCHED_STD, _RADII[1], _SEARCH_ROUNDS)
        found.append(tried)
        moved = [one.transform(tried).mesh.vertices for one in surfaces]
        at = np.concatenate([np.zeros((0, 3)), *moved])
        distance = np.asarray(known.tree.query(at, distance_upper_bound=_MAX_DISTANCE)[0])
        distance = np.minimum(distance, _MAX_DISTANCE)
        cost.append((float(distance.mean()) if len(distance) else 0.0) + penalty * abs(speed))
    return found[int(np.argmin(cost))]


def _refine(
    surfaces: Sequence[PartialSurface],
    known: PartialSurface,
    motion: Float,
    prior: Float,
    prior_std: tuple[float, ...],
    radius: float,
    rounds: int,
) -> Float:
    """The motion after Gauss-Newton steps with robust weights and a Gaussian prior."""
    information = np.diag(1.0 / np.square(prior_std))
    for _ in range(rounds):
        H, g = information.copy(), information @ (motion - prior)
        for one in surfaces:
            at, n, residual = _correspondences(one.transform(motion), known, radius)
            if len(at) < _MIN_POINTS:
                continue
            T = one.time_offset
            w = 1.0 / (1.0 + (residual / (3.0 * _POINT_STD)) ** 2) ** 2 / _POINT_STD**2
            w *= min(1.0, _INDEPENDENT_POINTS / len(at))
            around = at - motion_transform(motion, T)[1]
            turn = T * (n[:, 1] * around[:, 0] - n[:, 0] * around[:, 1])
            J = np.column_stack([T * n, turn, 0.5 * T**2 * n[:, :2]])
            H, g = H + J.T @ (w[:, None] * J), g + J.T @ (w * residual)
        motion = motion - np.linalg.solve(H, g)
    return motion


def _correspondences(
    one: PartialSurface, known: PartialSurface, radius: float
) -> tuple[Float, Float, Float]:
    """(n, 3) points with a nearest vertex, (n, 3) its normals, (n,) point-to-plane residuals."""
    at = one.mesh.vertices
    away, nearest = map(np.asarray, known.tree.query(at, distance_upper_bound=radius))
    near = np.flatnonzero(np.isfinite(away))
    normals = known.normals[nearest[near]]
    same = (one.normals[near] * normals).sum(axis=1) > _MIN_NORMAL_COSINE
    near, normals = near[same], normals[same]
    residual = ((at[near] - known.mesh.vertices[nearest[near]]) * normals).sum(axis=1)
    return at[near], normals, residual


def surface_distance(one: PartialSurface, known: PartialSurface) -> float:
    """Metres, third quartile of a surface's distances from another; NaN: too little in common."""
    residual = _correspondences(one.sample(_POINTS), known, _RADII[0])[2]
    if len(residual) < _MIN_POINTS:
        return float("nan")
    return float(np.quantile(np.abs(residual), 0.75))
