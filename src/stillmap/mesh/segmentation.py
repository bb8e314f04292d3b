"""Object segmentation: the returns of each moving object in its own frame, and their surface."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError

from stillmap.core import arrays
from stillmap.core.square_box import component_labels, neighbor_pairs
from stillmap.em.types import DYNAMIC_BELOW
from stillmap.mesh.inputs import MeshInputs
from stillmap.mesh.range_image import SMOOTHING_ROUNDS, beam_directions
from stillmap.mesh.tracked_boxes import ObjectFrame, TrackedBox
from stillmap.mesh.triangle_mesh import Mesh
from stillmap.mesh.types import Bool, Float, Float32, Index, Int32
from stillmap.tracking import MovingObject

IMAGE_WINDOW = 0.5  # s between an observation and an image of an object that is not rigid
_MIN_COSINE = 0.2  # from an object's center, up to which points are in one perspective image
_PASS_MARGIN = 0.25  # m behind a triangle from which on a beam has passed it
_MAX_STEEPNESS = 8.0  # length along the line of sight over length across
_SMOOTHING_KEPT = 0.5  # share of its range that a beam keeps in a round
_MAX_RANGE_STEP = 0.08  # m between neighbors that are smoothed together
_FAR_IMAGE_PENALTY = 4.0  # an interval far from all images counts 1 / (1 + this)


class ObjectBeams(NamedTuple):
    """Beams in an object's frame.

    Attributes:
        points: (n, 3) metres, end points.
        origin: (n, 3) metres, sensor positions.
    """

    points: Float
    origin: Float


def find_best_interval(
    seconds: Float, scan: Index, duration: float, images: Float
) -> tuple[float, float, float]:
    """The interval with most returns on an object, preferably near an image; start, end, score.

    Args:
        seconds: (n,) times of returns on it, n > 0.
        scan: (n,) number of the scan, rising.
        duration: s; 0: one scan.
        images: (N,) s, when images show the object; an interval `IMAGE_WINDOW` away from all
            counts one fifth.
    """
    if duration == 0.0:
        ends = np.flatnonzero(np.diff(scan)) + 1
        a, b = np.concatenate([[0], ends]), np.concatenate([ends, [len(scan)]])
        first, last = np.minimum.reduceat(seconds, a), np.maximum.reduceat(seconds, a)
        score = (b - a).astype(np.float64)
    else:
        first = np.sort(seconds)
        at = np.searchsorted(first, first + duration, side="right")
        last, score = first[at - 1], (at - np.arange(len(first))).astype(np.float64)
    if len(images):
        away = np.abs(0.5 * (first + last)[:, None] - images).min(axis=1)
        penalty = np.minimum(_FAR_IMAGE_PENALTY * away / IMAGE_WINDOW, _FAR_IMAGE_PENALTY)
        score = score / (1.0 + penalty)
    best = int(np.argmax(score))
    return float(first[best]), float(last[best]), float(score[best])


def triangulate_beams(
    own: ObjectBeams, others: ObjectBeams, stretch: float, max_edge: float, max_depth: float = 0.0
) -> Mesh:
    """The surface between beams on an object, triangulated as seen from their mean origin.

    Args:
        own: beams that ended on it.
        others: beams near in time that did not; NaN where their range is unknown.
        stretch: maximum length of an edge over the median.
        max_edge: metres.
        max_depth: metres; at grazing incidence edges along the line of sight may be so long.

    Returns:
        Metres in the object's frame; each vertex belongs to a beam.
    """
    if len(own.points) < 3:
        return Mesh.empty()
    sensor, center = own.origin.mean(axis=0), own.points.mean(axis=0)
    plane, ahead = _project_perspective(sensor, center, own.points)
    points, plane = own.points[ahead], plane[ahead]
    try:
        found = Delaunay(plane)
    except (QhullError, ValueError):  # all in one line
        return Mesh.empty()
    faces = found.simplices
    spans = points[faces] - points[np.roll(faces, 1, axis=1)]
    edges = np.linalg.norm(spans, axis=2)
    limit = min(stretch * float(np.median(edges)), max_edge)
    kept = edges.max(axis=1) <= limit
    if max_depth > 0.0:
        sight = points[faces].mean(axis=1) - sensor
        kept |= _is_grazing(spans, edges, sight, limit, max_depth)
    kept &= ~_is_passed(found, points, sensor, center, others)
    faces = _orient(points, faces[kept], sensor)
    if not len(faces):
        return Mesh.empty()
    used, number = np.unique(faces, return_inverse=True)
    faces = number.reshape(-1, 3).astype(np.int32)
    return Mesh(_smooth_ranges(points[used], faces, sensor), faces)


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
    they are in front."""
    towards = (center - sensor) / max(float(np.linalg.norm(center - sensor)), 1e-9)
    side = np.linalg.svd(towards[None])[2][1:]
    off = points - sensor
    depth = off @ towards
    with np.errstate(invalid="ignore", divide="ignore"):
        ahead = depth > _MIN_COSINE * np.linalg.norm(off, axis=1)
        return (off @ side.T) / depth[:, None], ahead


def _is_passed(
    found: Delaunay, points: Float, sensor: Float, center: Float, others: ObjectBeams
) -> Bool:
    """(m,) whether a beam went through a triangle and on behind it."""
    out = np.zeros(len(found.simplices), np.bool_)
    along = others.points - others.origin
    length = np.linalg.norm(along, axis=1, keepdims=True)
    # where it passed the object, as each beam has its own origin
    by = others.origin + along / length * np.linalg.norm(center - others.origin, axis=1)[:, None]
    plane, ahead = _project_perspective(sensor, center, by)
    some = np.flatnonzero(ahead)
    triangle = found.find_simplex(plane[some])
    some, triangle = some[triangle >= 0], triangle[triangle >= 0]
    depth = np.linalg.norm(points - sensor, axis=1)[found.simplices].max(axis=1)
    distance = np.linalg.norm(others.points[some] - sensor, axis=1)
    out[triangle[distance > depth[triangle] + _PASS_MARGIN]] = True
    return out


def _orient(points: Float, faces: NDArray[np.integer], sensor: Float) -> Int32:
    """(m, 3) the faces, counter-clockwise as seen from the sensor."""
    a, b, c = (points[faces[:, k]] for k in (0, 1, 2))
    away = np.einsum("ni,ni->n", np.cross(b - a, c - a), sensor - a) < 0.0
    return np.where(away[:, None], faces[:, ::-1], faces).astype(np.int32)


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


NO_OWNER = -1
_BOX_MARGIN = 0.15  # m around an object's box within which returns are its own
_GROUND_CLEARANCE = 0.03  # m above the ground: lower returns are the ground's
LINK = 0.5  # m between connected parts of a vehicle
SPACING = 0.025  # rad between beams, at most
HALF_CAR = 3.0  # m, from the center of a car to its ends
_CAR_LENGTH = 6.0  # m
_MAX_RANGE = 1000.0  # m, end of beams without a return
_CELL = 0.2  # m, in which one point is enough
_CONE_MARGIN = 0.05  # rad around an object, of beams that pass beside it


class DynamicReturns(NamedTuple):
    """The K returns of a recording on moving objects.

    Attributes:
        inputs: the recording.
        beam: (K,) beam numbers, rising.
        seconds: (K,) times, by the clock of boxes.
        ends: (K, 3) metres in the map frame.
        owner: (K,) id of the object; -1: none.
        is_dynamic: (K,) whether P(static) is below one half; not all returns with an owner are.
    """

    inputs: MeshInputs
    beam: Index
    seconds: Float
    ends: Float
    owner: Int32
    is_dynamic: Bool

    @classmethod
    def collect(cls, inputs: MeshInputs) -> "DynamicReturns":
        """All returns that are dynamic or belong to an object."""
        deskewed, objects = inputs.deskewed, inputs.objects
        owned = np.concatenate([np.zeros(0, np.intp), *(one.beams for one in objects)])
        whose = np.repeat([one.id for one in objects], [len(one.beams) for one in objects])
        beam = np.union1d(_dynamic_beams(deskewed.hit, inputs.p_static), owned).astype(np.intp)
        owner = np.full(len(beam), NO_OWNER, np.int32)
        owner[np.searchsorted(beam, owned)] = whose
        dynamic = deskewed.hit[beam] & (inputs.p_static[beam] < DYNAMIC_BELOW)
        seconds, ends = inputs.seconds_of(beam), deskewed.end_points(beam, inputs.poses)
        return cls(inputs, beam, seconds, ends, owner, dynamic)

    def take(self, numbers: Index | slice) -> "DynamicReturns":
        """Some of the returns."""
        parts = {name: getattr(self, name)[numbers] for name in self._fields[1:]}
        return self._replace(**parts)

    def tracked(self) -> "DynamicReturns":
        """Dynamic returns on objects that have a box, sorted by time."""
        boxed = np.isin(self.owner, [one.box.object_id for one in self.inputs.boxes])
        kept = np.flatnonzero(self.is_dynamic & boxed)
        return self.take(kept[np.argsort(self.seconds[kept], kind="stable")])

    def in_beam_range(self, first: int, last: int) -> slice:
        """Returns of beams first:last."""
        a, b = np.searchsorted(self.beam, [first, last])
        return slice(int(a), int(b))


def _dynamic_beams(hit: Bool, p_static: Float32) -> Index:
    """Beams that hit something rather dynamic than static, found block by block."""
    found = [np.zeros(0, np.intp)]
    for block in arrays.iter_blocks(hit, p_static):
        dynamic = hit[block] & (p_static[block] < DYNAMIC_BELOW)
        found.append(block.start + np.flatnonzero(dynamic))
    return np.concatenate(found)


def segment_object(one: MovingObject, tracked: TrackedBox, returns: DynamicReturns) -> Index:
    """(n,) returns of an object: rising numbers within `returns`.

    Dynamic returns in the box around it that belong to no other object, and its own not far beside.
    """
    box, inputs, offset = tracked.box, returns.inputs, returns.inputs.deskewed.offset
    stamps = 1e-9 * (inputs.deskewed.stamp_ns - inputs.start_ns)
    a = int(np.searchsorted(stamps, box.seconds[0] - box.hold))
    b = max(int(np.searchsorted(stamps, box.seconds[-1] + box.hold, side="right")), a)
    some = returns.in_beam_range(int(offset[a]), int(offset[b]))
    half = np.array(box.half_size) + _BOX_MARGIN
    # returns far from the whole track need no test against the box
    reach = max(float(np.linalg.norm(half)) + _BOX_MARGIN, HALF_CAR)
    way = box.center_at(np.concatenate([box.seconds, box.seconds[[0, -1]] + [-box.hold, box.hold]]))
    low, high = way.min(axis=0) - reach, way.max(axis=0) + reach
    x, y = returns.ends[some, 0], returns.ends[some, 1]
    near = (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])
    near &= (returns.owner[some] == one.id) | (returns.owner[some] == NO_OWNER)
    number = some.start + np.flatnonzero(near)
    frame = ObjectFrame.from_track(tracked)
    at = frame.to_object(returns.seconds[number], returns.ends[number])
    inside = (np.abs(at[:, :2]) <= half).all(axis=1)
    inside &= (at[:, 2] > _GROUND_CLEARANCE) & (at[:, 2] <= tracked.height + _BOX_MARGIN)
    # the track of one person may capture another beside
    mine = (np.abs(at[:, :2]) <= half + _BOX_MARGIN).all(axis=1)
    if tracked.is_large and not tracked.is_fast:
        # the center of the visible part moves about on a large object
        mine = np.linalg.norm(at[:, :2], axis=1) <= HALF_CAR
    kept = np.where(returns.owner[number] == one.id, mine, inside)
    return np.asarray(number[kept], np.intp)


def grow_segment(
    own: Index, within: Index, frame: ObjectFrame, sensor: Float, returns: DynamicReturns
) -> Index:
    """(n,) the returns of a fast object and all dynamic returns connected with them.

    Parts of a car are often tracked separately.

    Args:
        own: numbers within `returns` that are known to be of the object, rising.
        within: rising numbers of all that may be.
        frame: of the object.
        sensor: (3,) metres, sensor position in that frame.
        returns: all dynamic returns.
    """
    within = within[returns.is_dynamic[within]]
    at = frame.to_object(returns.seconds[within], returns.ends[within])
    some = (at[:, 2] > _GROUND_CLEARANCE) & (np.linalg.norm(at[:, :2], axis=1) <= _CAR_LENGTH)
    within, at = within[some], at[some]
    there = frame.to_object(returns.seconds[own], returns.ends[own])
    own = own[np.linalg.norm(there[:, :2], axis=1) <= _CAR_LENGTH]
    if not len(within):
        return own
    away = float(np.median(np.linalg.norm(at - sensor, axis=1)))
    cluster = cluster_cells(at, _CELL, LINK + SPACING * away)
    mine = np.isin(within, own)
    return np.union1d(own, within[np.isin(cluster, cluster[mine])])


def cluster_cells(points: Float, edge: float, link: float) -> Index:
    """(n,) cluster of points (n, 3) whose cells are connected by steps of at most `link` metres."""
    cells, of = arrays.unique_cells(np.floor(points / edge).astype(np.int64))
    return component_labels(neighbor_pairs(cells, link / edge), len(cells))[of]


def beams_in_frame(
    beams: Index, seconds: Float, frame: ObjectFrame, inputs: MeshInputs
) -> ObjectBeams:
    """Beams (n,), rising, taken at times (n,), in an object's frame.

    Beams without a return are extended to a kilometre.
    """
    deskewed = inputs.deskewed
    ends = deskewed.end_points(beams, inputs.poses)
    origin = inputs.T_map_sensor[deskewed.scans_of(beams), :3, 3]
    along = ends - origin
    with np.errstate(invalid="ignore", divide="ignore"):
        far = origin + along * (_MAX_RANGE / np.linalg.norm(along, axis=1, keepdims=True))
    ends = np.where(deskewed.hit[beams][:, None], ends, far)
    return ObjectBeams(frame.to_object(seconds, ends), frame.to_object(seconds, origin))


def in_viewing_cone(mine: Index, beams: Index, inputs: MeshInputs) -> Bool:
    """(n,) which beams (n,) point to where the returns `mine`, at least one, lie."""
    deskewed = inputs.deskewed
    center = deskewed.end_points(mine, inputs.poses).mean(axis=0)
    own, other = (_cosine_to(center, some, inputs) for some in (mine, beams))
    widest = np.arccos(np.clip(own.min(), -1.0, 1.0)) + _CONE_MARGIN
    return np.asarray(other >= np.cos(min(float(widest), np.pi)))


def _cosine_to(target: Float, beams: Index, inputs: MeshInputs) -> Float:
    """(n,) cosine of the angle between beams and the direction from the sensor to a point (3,)."""
    deskewed = inputs.deskewed
    first, last = deskewed.scans_of(beams[[0, -1]]) if len(beams) else (0, -1)
    T = inputs.T_map_sensor[first : last + 1]
    axis = np.einsum("nji,nj->ni", T[:, :3, :3], target - T[:, :3, 3])
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    directions = beam_directions(deskewed.points[beams])
    return np.asarray(np.einsum("ni,ni->n", directions, axis[deskewed.scans_of(beams) - first]))
