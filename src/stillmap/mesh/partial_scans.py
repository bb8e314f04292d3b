"""Partial scans of moving objects: what was seen of one at a time, and its surface (Sect. 4.5)."""

from typing import NamedTuple

import numpy as np
from scipy.spatial import Delaunay, QhullError

from stillmap.core.array_types import Bool, Float, Index, Int32
from stillmap.mesh.range_image import SMOOTHING_ROUNDS
from stillmap.mesh.returns import SPACING, DynamicReturns, grow_segment
from stillmap.mesh.tracked_boxes import ObjectFrame
from stillmap.mesh.triangle_mesh import Mesh, remove_small_components

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
    scans, deskewed = inputs.scans_within(first, last), inputs.deskewed
    beams = np.arange(deskewed.offset[scans.start], deskewed.offset[scans.stop])
    seconds = inputs.seconds_of(beams)
    then = (seconds >= first) & (seconds <= last)
    beams, seconds = beams[then], seconds[then]
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
    return np.asarray(
        (across <= limit) & (deep.max(axis=1) <= np.minimum(max_depth, _MAX_STEEPNESS * across))
    )


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
