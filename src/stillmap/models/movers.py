"""Models of what moved (Sect. 4.5): what ended on a thing, in its own frame, as a surface."""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.models.aligning import Sweep, aligned
from stillmap.models.frames import Way
from stillmap.models.options import MoverOptions
from stillmap.models.sources import Sources
from stillmap.objects import MovingObject
from stillmap.recording.model import Recording
from stillmap.recording.stamps import beam_ns
from stillmap.surface.building import fused
from stillmap.surface.mesh import Mesh
from stillmap.surface.options import SurfaceOptions
from stillmap.surface.patches import Patch, order_of, patches_of
from stillmap.texture.things import Thing

Float = NDArray[np.float64]

_DYNAMIC = 0.5
_FINEST, _COARSEST = 0.025, 0.06  # m, edges of voxels
_OF_SPACING = 0.7  # of how far beams lie apart


@dataclass(frozen=True, eq=False)
class Shape:
    """The surface of a thing that moved.

    Attributes:
        id: of the object.
        mesh: in the thing's own frame: x ahead, y left, z up, on the ground below its middle.
        way: where that frame was.
        rigid: whether it kept its shape.
        seconds: when it was of this shape: of one that is not rigid the middle of the sweep, of a
            rigid one when most of it was seen; by the time of its box.
        span: s, from the first beam of that sweep to the last; what is rigid: all of its track.
    """

    id: int
    mesh: Mesh
    way: Way
    rigid: bool
    seconds: float
    span: tuple[float, float]


class Piece(NamedTuple):
    """Triangles of one range image that lie on a thing.

    Attributes:
        patch: in the map frame; of the points those are of the thing that its faces use.
        weight: (m,) of its faces: how probably all of their beams are dynamic.
        seconds: (n,) when the beam of each point was taken.
    """

    patch: Patch
    weight: NDArray[np.float32]
    seconds: Float

    def in_frame(self, way: Way) -> "Piece":
        """The same in the thing's own frame, each beam as it was at its time."""
        at, origin = (
            way.local(self.seconds, xyz) for xyz in (self.patch.points, self.patch.origin)
        )
        return self._replace(patch=self.patch._replace(points=at, origin=origin))

    def within(self, first: float, last: float) -> "Piece":
        """The faces all of whose beams were taken between two times."""
        inside = (self.seconds >= first) & (self.seconds <= last)
        kept = inside[self.patch.faces].all(axis=1)
        patch = self.patch._replace(faces=self.patch.faces[kept])
        return self._replace(patch=patch, weight=self.weight[kept])

    def areas(self) -> Float:
        """(m,) square metres."""
        return Mesh(self.patch.points, self.patch.faces).areas()

    def times(self) -> Float:
        """(m,) when each face was seen."""
        return np.asarray(self.seconds[self.patch.faces].mean(axis=1))


def shape_of(
    one: MovingObject,
    thing: Thing,
    sources: Sources,
    options: MoverOptions,
    surface: SurfaceOptions,
    pictures: Float,
) -> Shape | None:
    """The surface of something that moved; None where too little of it was seen.

    Args:
        one: the object.
        thing: the same as a box on its way.
        sources: the beams.
        options: see MoverOptions.
        surface: see SurfaceOptions.
        pictures: (N,) s, when pictures show it, by the time of its box.
    """
    pieces = list(pieces_of(one, thing, sources, options, surface))
    way, rigid = Way.of_track(thing), 2.0 * thing.box.half[0] >= options.rigid
    if not pieces:
        return None
    if rigid:
        way = _laid_over(pieces, way)
        weight = np.array([one.areas().sum() for one in pieces])
        seconds = float(np.median(pieces[int(np.argmax(weight))].seconds))
        span = float(thing.box.seconds[0]), float(thing.box.seconds[-1])
    else:
        # a scan in space sees all of it at once, planar scans one after the other
        tilts = any(len(np.unique(sources.seen.scans_of(piece.patch.beam))) > 1 for piece in pieces)
        span = best_sweep(pieces, options.sweep if tilts else 0.0, options.near, pictures)
        seconds = 0.5 * (span[0] + span[1])
        pieces = [piece.within(*span) for piece in pieces]
    local = [piece.in_frame(way) for piece in pieces]
    limits = dataclasses.replace(surface, island=options.island)
    voxel = options.voxel or voxel_for(local)
    mesh = fused([(piece.patch, piece.weight) for piece in local], voxel, limits)
    if mesh.areas().sum() < options.least:
        return None
    return Shape(one.id, mesh, way, rigid, seconds, span)


def voxel_for(pieces: Sequence[Piece]) -> float:
    """Metres: a little less than beams lie apart on a thing, within bounds."""
    edges = [np.zeros(0)]
    for piece in pieces:
        corners = piece.patch.points[piece.patch.faces]
        edges.append(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).ravel())
    all_edges = np.concatenate(edges)
    apart = float(np.median(all_edges)) if len(all_edges) else _FINEST
    return float(np.clip(_OF_SPACING * apart, _FINEST, _COARSEST))


def pieces_of(
    one: MovingObject,
    thing: Thing,
    sources: Sources,
    options: MoverOptions,
    surface: SurfaceOptions,
) -> Iterator[Piece]:
    """Triangles between neighbouring beams that end on a thing, range image by range image."""
    own, first = own_beams(one, thing, sources, options)
    if not own.hit.any():
        return
    poses = sources.poses[first.scan : first.scan + own.n_scans]
    counts = np.add.reduceat(own.hit, own.offset[:-1]) * (np.diff(own.offset) > 0)
    order = order_of(own, np.flatnonzero(counts), surface)
    for make in patches_of(own, poses, order, surface):
        patch = make()
        dynamic = 1.0 - sources.p_static[first.beam + patch.beam].astype(np.float64)
        weight = np.nan_to_num(dynamic)[patch.faces].prod(axis=1)
        kept = weight >= surface.least
        if not kept.any():
            continue
        seconds = first.seconds[patch.beam]
        whole = patch._replace(faces=patch.faces[kept], beam=first.beam + patch.beam)
        yield _used(whole, weight[kept], seconds)


def _used(patch: Patch, weight: Float, seconds: Float) -> Piece:
    """Without the points that no face uses."""
    used = np.unique(patch.faces)
    number = np.zeros(len(patch.points), np.int32)
    number[used] = np.arange(len(used))
    patch = Patch(
        patch.points[used],
        number[patch.faces],
        patch.beam[used],
        patch.origin[used],
        patch.standoff[used],
    )
    return Piece(patch, weight.astype(np.float32), seconds[used])


class First(NamedTuple):
    """Where a part of a recording begins in it, and when its beams were taken.

    Attributes:
        scan, beam: numbers of its first ones.
        seconds: (n,) of its beams, by the time of boxes.
    """

    scan: int
    beam: int
    seconds: Float


def own_beams(
    one: MovingObject, thing: Thing, sources: Sources, options: MoverOptions
) -> tuple[Recording, First]:
    """The scans that saw a thing, in which only what ended on it is a hit.

    That is what is rather dynamic than static, in the box around it, and of no other thing.
    """
    seen, box = sources.seen, thing.box
    stamps = 1e-9 * (seen.stamp_ns - sources.start_ns)
    a = int(np.searchsorted(stamps, box.seconds[0] - box.hold))
    b = max(int(np.searchsorted(stamps, box.seconds[-1] + box.hold, side="right")), a)
    scans, beams = slice(a, b), slice(int(seen.offset[a]), int(seen.offset[b]))
    seconds = np.asarray(1e-9 * (beam_ns(sources.recording, scans) - sources.start_ns), np.float64)
    own = np.zeros(beams.stop - beams.start, np.bool_)
    moves = np.flatnonzero(seen.hit[beams] & (sources.p_static[beams] < _DYNAMIC))
    ends = seen.end_points(beams.start + moves, sources.poses)
    at = Way.of_track(thing).local(seconds[moves], ends)
    half = np.array(box.half) + options.margin
    inside = (np.abs(at[:, :2]) <= half).all(axis=1)
    inside &= (at[:, 2] > options.low) & (at[:, 2] <= thing.tall + options.margin)
    own[moves[inside]] = True
    for other in sources.objects:
        if other.id != one.id:
            theirs = other.beams[np.searchsorted(other.beams, beams.start) :]
            theirs = theirs[: np.searchsorted(theirs, beams.stop)]
            own[theirs - beams.start] = False
    mine = one.beams[(one.beams >= beams.start) & (one.beams < beams.stop)] - beams.start
    own[mine] = True
    part = dataclasses.replace(
        seen,
        stamp_ns=seen.stamp_ns[scans],
        offset=seen.offset[a : b + 1] - seen.offset[a],
        points=np.asarray(seen.points[beams]),
        hit=own,
        sensor=seen.sensor[scans],
        T_odom_base=None,
        T_recorded_base=None,
        beam_time=None,
        images=None,
    )
    return part, First(a, beams.start, seconds)


def best_sweep(
    pieces: Sequence[Piece], sweep: float, near: float, pictures: Float
) -> tuple[float, float]:
    """From when to when most of a thing was seen, in `sweep` seconds; rather where a picture is.

    With 0 it is a range image that counts. A time without a picture within `near` seconds counts
    a third.
    """
    if sweep == 0.0:
        ends = np.array([(piece.seconds.min(), piece.seconds.max()) for piece in pieces])
        first, final = ends.T
        value = np.array([piece.areas().sum() for piece in pieces])
    else:
        times = np.concatenate([piece.times() for piece in pieces])
        areas = np.concatenate([piece.areas() for piece in pieces])
        order = np.argsort(times, kind="stable")
        first, total = times[order], np.concatenate([[0.0], np.cumsum(areas[order])])
        last = np.searchsorted(first, first + sweep, side="right")
        final, value = first[last - 1], total[last] - total[:-1]
    if len(pictures):
        middle = 0.5 * (first + final)
        away = np.abs(middle[:, None] - pictures).min(axis=1)
        value = np.where(away <= near, value, value / 3.0)
    best = int(np.argmax(value))
    return float(first[best]), float(final[best])


def _laid_over(pieces: Sequence[Piece], way: Way) -> Way:
    """The way on which all sweeps of a rigid thing lie over each other."""
    local = [piece.in_frame(way) for piece in pieces]
    offset = aligned([_sweep(piece) for piece in local])
    seconds = np.array([float(np.median(piece.seconds)) for piece in local])
    order = np.argsort(seconds, kind="stable")
    return Way(way.thing, seconds[order], offset[order])


def _sweep(piece: Piece) -> Sweep:
    """The points of a piece with the normals of the faces around each."""
    points, faces = piece.patch.points, piece.patch.faces
    mesh = Mesh(points, faces)
    spans = mesh.normals() * mesh.areas()[:, None]
    normals = np.stack(
        [
            np.bincount(faces.ravel(), np.repeat(column, 3), minlength=len(points))
            for column in spans.T
        ],
        axis=1,
    )
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    around = np.bincount(faces.ravel(), np.repeat(piece.weight, 3), minlength=len(points))
    count = np.bincount(faces.ravel(), minlength=len(points))
    return Sweep(points, normals / np.maximum(length, 1e-12), around / np.maximum(count, 1))
