"""Which beams met a thing that moves, and these in its own frame."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from stillmap.core import arrays
from stillmap.mapping.beam_statistics import DYNAMIC_BELOW
from stillmap.mesh import range_image
from stillmap.mesh.inputs import MeshInputs
from stillmap.mesh.objects.frame import ObjectFrame
from stillmap.mesh.objects.sweep_surface import ObjectBeams
from stillmap.mesh.options import MoverOptions
from stillmap.mesh.texture.occluders import TrackedBox
from stillmap.tracking import MovingObject

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]
Index = NDArray[np.intp]

NO_OWNER = -1
_FAR = 1000.0  # m
_OFTEN = 0.9  # of the time something is not faster
_REACH = 3.0  # m, from the middle of a car to its ends
_CAR = 6.0  # m, from one end of it to the other
_CELL = 0.2  # m, in which one point is enough
_ASKED = 9  # scans that tell whether they are planar
_BESIDE = 1  # scans before and after a time in which beams may be of it
_BEYOND = 0.05  # rad beyond a thing, up to where beams are beside it
SPACING = 0.025  # rad between beams, at most


class DynamicReturns(NamedTuple):
    """The K beams of a recording that ended on what moves.

    Attributes:
        beam: (K,) their numbers, rising.
        seconds: (K,) when they were taken, by the time of boxes.
        ends: (K, 3) metres in the map frame.
        owner: (K,) the object that each is of; -1: none.
        dynamic: (K,) whether it is rather dynamic than static; what has an owner may be not.
        planar: whether scans are rows.
    """

    beam: Index
    seconds: Float
    ends: Float
    owner: NDArray[np.int32]
    is_dynamic: Bool
    is_planar: bool

    @classmethod
    def collect(cls, sources: MeshInputs) -> "DynamicReturns":
        """All that moves, once for all things."""
        seen, objects = sources.deskewed, sources.objects
        owned = np.concatenate([np.zeros(0, np.intp), *(one.beams for one in objects)])
        whose = np.repeat([one.id for one in objects], [len(one.beams) for one in objects])
        beam = np.union1d(_dynamic(seen.hit, sources.p_static), owned).astype(np.intp)
        owner = np.full(len(beam), NO_OWNER, np.int32)
        owner[np.searchsorted(beam, owned)] = whose
        dynamic = seen.hit[beam] & (sources.p_static[beam] < DYNAMIC_BELOW)
        seconds, ends = beam_seconds(beam, sources), seen.end_points(beam, sources.poses)
        asked = np.unique(np.linspace(0, seen.n_scans - 1, min(seen.n_scans, _ASKED)).astype(int))
        planar = [
            range_image.is_planar(range_image.beam_directions(seen.points[seen.beams_of(t)]))
            for t in asked
        ]
        return cls(beam, seconds, ends, owner, dynamic, 2 * sum(planar) > len(planar))

    def in_beam_range(self, first: int, last: int) -> slice:
        """Those with numbers from the first to before the last."""
        a, b = np.searchsorted(self.beam, [first, last])
        return slice(int(a), int(b))


def _dynamic(hit: Bool, p_static: NDArray[np.float32]) -> Index:
    """The beams that hit something rather dynamic than static; little waits in memory."""
    found = [np.zeros(0, np.intp)]
    for block in arrays.iter_blocks(hit, p_static):
        moves = hit[block] & (p_static[block] < DYNAMIC_BELOW)
        found.append(block.start + np.flatnonzero(moves))
    return np.concatenate(found)


def beam_seconds(beams: Index, sources: MeshInputs) -> Float:
    """(n,) when beams (n,), rising, were taken, by the time of boxes."""
    recording = sources.recording
    times = recording.stamp_ns[recording.scans_of(beams)]
    if recording.beam_time is not None:
        times = times + np.round(1e9 * recording.beam_time[beams].astype(np.float64)).astype(int)
    return np.asarray(1e-9 * (times - sources.start_ns), np.float64)


def scans_within(first: float, last: float, sources: MeshInputs) -> slice:
    """The scans that have beams of these times, and some others beside."""
    stamps = 1e-9 * (sources.deskewed.stamp_ns - sources.start_ns)
    reach = 1e-9 * sources.max_scan_ns
    a = int(np.searchsorted(stamps, first - reach)) - _BESIDE
    b = int(np.searchsorted(stamps, last + reach, side="right")) + _BESIDE
    return slice(max(a, 0), min(b, len(stamps)))


def is_fast(thing: TrackedBox, options: MoverOptions) -> bool:
    """Whether it is faster than people are."""
    speed = np.linalg.norm(thing.box.velocity, axis=1)
    return bool(np.quantile(speed, _OFTEN) > options.fast)


def is_large(thing: TrackedBox, options: MoverOptions) -> bool:
    """Whether it is longer or wider than people are."""
    return 2.0 * max(thing.box.half_size) >= options.rigid


def segment_object(
    one: MovingObject,
    thing: TrackedBox,
    moves: DynamicReturns,
    sources: MeshInputs,
    options: MoverOptions,
) -> Index:
    """(n,) of what moves that which ended on a thing: rising numbers within `moves`.

    That is what is rather dynamic than static, in the box around it, and of no other thing.
    """
    box, offset = thing.box, sources.deskewed.offset
    stamps = 1e-9 * (sources.deskewed.stamp_ns - sources.start_ns)
    a = int(np.searchsorted(stamps, box.seconds[0] - box.hold))
    b = max(int(np.searchsorted(stamps, box.seconds[-1] + box.hold, side="right")), a)
    some = moves.in_beam_range(int(offset[a]), int(offset[b]))
    half = np.array(box.half_size) + options.margin
    # what is far from all of its way need not be asked where it was then
    reach = max(float(np.linalg.norm(half)) + options.margin, _REACH)
    way = box.center_at(np.concatenate([box.seconds, box.seconds[[0, -1]] + [-box.hold, box.hold]]))
    low, high = way.min(axis=0) - reach, way.max(axis=0) + reach
    x, y = moves.ends[some, 0], moves.ends[some, 1]
    near = (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])
    near &= (moves.owner[some] == one.id) | (moves.owner[some] == NO_OWNER)
    number = some.start + np.flatnonzero(near)
    at = ObjectFrame.from_track(thing).to_object(moves.seconds[number], moves.ends[number])
    inside = (np.abs(at[:, :2]) <= half).all(axis=1)
    inside &= (at[:, 2] > options.low) & (at[:, 2] <= thing.height + options.margin)
    # a track of somebody may take hold of who stands beside
    mine = (np.abs(at[:, :2]) <= half + options.margin).all(axis=1)
    if is_large(thing, options) and not is_fast(thing, options):
        # the middle of what is seen of it goes to and fro on it
        mine = np.linalg.norm(at[:, :2], axis=1) <= _REACH
    kept = np.where(moves.owner[number] == one.id, mine, inside)
    return np.asarray(number[kept], np.intp)


def grow_segment(
    own: Index,
    within: Index,
    way: ObjectFrame,
    place: Float,
    moves: DynamicReturns,
    options: MoverOptions,
) -> Index:
    """(n,) of what moves that which hangs together with what is known to be of a thing.

    Of things that are faster than people all that moves beside them is theirs: parts of a car are
    often followed each on its own.

    Args:
        own: numbers within `moves` that are known to be of it, rising.
        within: rising numbers of all that may be.
        way: where its own frame is.
        place: (3,) metres in that frame, where the sensor was.
        moves: all that moves.
        options: see MoverOptions.
    """
    within = within[moves.is_dynamic[within]]
    at = way.to_object(moves.seconds[within], moves.ends[within])
    some = (at[:, 2] > options.low) & (np.linalg.norm(at[:, :2], axis=1) <= _CAR)
    within, at = within[some], at[some]
    there = way.to_object(moves.seconds[own], moves.ends[own])
    own = own[np.linalg.norm(there[:, :2], axis=1) <= _CAR]
    if not len(within):
        return own
    away = float(np.median(np.linalg.norm(at - place, axis=1)))
    link = options.link + SPACING * away
    piece = cluster_cells(at, _CELL, link)
    mine = np.isin(within, own)
    return np.union1d(own, within[np.isin(piece, piece[mine])])


def cluster_cells(points: Float, edge: float, link: float) -> Index:
    """(n,) which piece points (n, 3) are of: their cells are at most `link` metres apart."""
    cells, of = unique_cells(points, edge)
    one, other = cKDTree(cells).query_pairs(link / edge, output_type="ndarray").T
    n = len(cells)
    graph = coo_matrix((np.ones(len(one), np.int8), (one, other)), (n, n))
    return np.asarray(connected_components(graph, directed=False)[1][of], np.intp)


def unique_cells(points: Float, edge: float) -> tuple[Float, Index]:
    """(m, 3) the cells that points (n, 3) lie in, numbers along each axis, and (n,) whose is which.

    Rising, as `np.unique` has them, which takes ten times as long for rows.
    """
    cells = np.floor(points / edge).astype(np.int64)
    low = cells.min(axis=0)
    x, y, z = (cells.max(axis=0) - low + 1).tolist()
    if x * y * z >= 1 << 62:
        raise ValueError("points: too far apart")
    key = ((cells[:, 0] - low[0]) * y + cells[:, 1] - low[1]) * z + cells[:, 2] - low[2]
    key, of = np.unique(key, return_inverse=True)
    distinct = np.stack([key // (y * z), key // z % y, key % z], axis=1) + low
    return distinct.astype(np.float64), of


def beams_in_frame(
    beams: Index, seconds: Float, way: ObjectFrame, sources: MeshInputs
) -> ObjectBeams:
    """Beams (n,), rising, taken at times (n,), in a thing's own frame.

    Those that came back from nowhere go on for a kilometre.
    """
    seen = sources.deskewed
    ends = seen.end_points(beams, sources.poses)
    scan = seen.scans_of(beams)
    T = sources.poses[scan] @ seen.T_base_sensor[seen.sensor[scan]]
    origin = T[:, :3, 3]
    with np.errstate(invalid="ignore", divide="ignore"):
        far = origin + (ends - origin) * (
            _FAR / np.linalg.norm(ends - origin, axis=1, keepdims=True)
        )
    ends = np.where(seen.hit[beams][:, None], ends, far)
    return ObjectBeams.from_map(ends, origin, seconds, way)


def in_viewing_cone(mine: Index, beams: Index, sources: MeshInputs) -> Bool:
    """(n,) which of beams (n,) look about where others, n > 0, ended; unknown ones do not."""
    seen = sources.deskewed
    middle = seen.end_points(mine, sources.poses).mean(axis=0)
    own, other = (_towards(middle, some, sources) for some in (mine, beams))
    widest = np.arccos(np.clip(own.min(), -1.0, 1.0)) + _BEYOND
    return np.asarray(other >= np.cos(min(float(widest), np.pi)))


def _towards(middle: Float, beams: Index, sources: MeshInputs) -> Float:
    """(n,) cosine of the angle between beams and the way from the sensor to a place (3,)."""
    seen = sources.deskewed
    first, last = seen.scans_of(beams[[0, -1]]) if len(beams) else (0, -1)
    scans = np.arange(first, last + 1)
    T = sources.poses[scans] @ seen.T_base_sensor[seen.sensor[scans]]
    axis = np.einsum("nji,nj->ni", T[:, :3, :3], middle - T[:, :3, 3])
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    looking = range_image.beam_directions(seen.points[beams])
    return np.asarray(np.einsum("ni,ni->n", looking, axis[seen.scans_of(beams) - first]))
