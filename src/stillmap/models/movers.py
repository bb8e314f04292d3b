"""Models of what moved (Sect. 4.5): what ended on a thing, in its own frame, as a surface."""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.models.aligning import Sweep, aligned, spread
from stillmap.models.frames import Way
from stillmap.models.moments import best_moment, between_beams
from stillmap.models.options import MoverOptions
from stillmap.models.own import SPACING, First, grown, look_of, own_beams
from stillmap.models.sources import Sources
from stillmap.objects import MovingObject
from stillmap.recording.model import Recording
from stillmap.surface.building import fused
from stillmap.surface.extraction import without_islands
from stillmap.surface.mesh import Mesh
from stillmap.surface.options import SurfaceOptions
from stillmap.surface.patches import Patch, order_of, patches_of
from stillmap.texture.things import Thing

Float = NDArray[np.float64]

_FINEST, _COARSEST = 0.025, 0.06  # m, edges of voxels
_OF_SPACING = 0.7  # of how far beams lie apart
_AROUND = 0.03  # s, in which a scan sees the rest of a car
_MOSTLY = 0.1  # of what hangs together is of a track: else another one follows it
_OFTEN = 0.9  # of the time something is not faster


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

    def areas(self) -> Float:
        """(m,) square metres."""
        return Mesh(self.patch.points, self.patch.faces).areas()


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
    own, first = own_beams(one, thing, sources, options)
    if not own.hit.any():
        return None
    way, shape = Way.of_track(thing), None
    if options.together and 2.0 * thing.box.half[0] >= options.rigid:
        shape = _put_together(one.id, way, own, first, sources, options, surface)
    return shape or _in_a_moment(one.id, way, own, first, sources, options, surface, pictures)


def _put_together(
    id: int,
    way: Way,
    own: Recording,
    first: First,
    sources: Sources,
    options: MoverOptions,
    surface: SurfaceOptions,
) -> Shape | None:
    """All that was seen of what keeps its shape; None where that is too little."""
    pieces = list(pieces_of(own, first, sources, surface))
    if not pieces:
        return None
    laid = _laid_over(pieces, way, options.blurred)
    if laid is None:
        return None
    way = laid
    weight = np.array([one.areas().sum() for one in pieces])
    seconds = float(np.median(pieces[int(np.argmax(weight))].seconds))
    box = way.thing.box
    local = [piece.in_frame(way) for piece in pieces]
    limits = dataclasses.replace(surface, island=options.island)
    voxel = options.voxel or voxel_for(local)
    mesh = fused([(piece.patch, piece.weight) for piece in local], voxel, limits)
    if mesh.areas().sum() < options.least:
        return None
    return Shape(id, mesh, way, True, seconds, (float(box.seconds[0]), float(box.seconds[-1])))


def _in_a_moment(
    id: int,
    way: Way,
    own: Recording,
    first: First,
    sources: Sources,
    options: MoverOptions,
    surface: SurfaceOptions,
    pictures: Float,
) -> Shape | None:
    """What one look saw of it: a scan in space, or planar ones that follow one another."""
    hits = np.flatnonzero(own.hit)
    planar = order_of(own, hits[:0], surface).planar
    speed = np.linalg.norm(way.thing.box.velocity, axis=1)
    fast = bool(np.quantile(speed, _OFTEN) > options.fast)
    # who is seen by few beams is looked at longer
    for moment in (options.sweep, 2.0 * options.sweep) if planar else (0.0,):
        span = best_moment(first.seconds[hits], own.scans_of(hits), moment, options.near, pictures)
        around = _AROUND if fast else 0.0
        then = (first.seconds >= span[0] - around) & (first.seconds <= span[1] + around)
        beams = np.flatnonzero(then)
        mine = own.hit[beams]
        if fast:
            whole = grown(beams, mine, way, first, sources, options)
            if mine.sum() < _MOSTLY * whole.sum():
                continue
            mine = whole
            span = float(first.seconds[beams[mine]].min()), float(first.seconds[beams[mine]].max())
        looks = [look_of(some, way, first, sources) for some in (beams[mine], beams[~mine])]
        stretch, longest = options.stretch, options.longest
        if fast:  # its sides are seen at flat angles
            away = np.linalg.norm(looks[0].points - looks[0].origin, axis=1)
            stretch, longest = np.inf, max(longest, SPACING * float(np.median(away)))
        mesh = between_beams(looks[0], looks[1], stretch, longest)
        mesh = without_islands(mesh, options.island)
        if mesh.areas().sum() >= options.least:
            return Shape(id, mesh, way, False, 0.5 * (span[0] + span[1]), span)
    return None


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
    own: Recording, first: First, sources: Sources, surface: SurfaceOptions
) -> Iterator[Piece]:
    """Triangles between neighbouring beams that end on a thing, range image by range image.

    Args:
        own, first: see `own_beams`.
        sources: the beams.
        surface: see SurfaceOptions.
    """
    poses = sources.poses[first.scan : first.scan + own.n_scans]
    met = np.unique(own.scans_of(np.flatnonzero(own.hit)))
    order = order_of(own, met, surface)
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


def _laid_over(pieces: Sequence[Piece], way: Way, blurred: float) -> Way | None:
    """The way on which all sweeps of a rigid thing lie over each other; None: they do not."""
    sweeps = [_sweep(piece.in_frame(way)) for piece in pieces]
    offset = aligned(sweeps)
    if spread(sweeps, offset) > blurred:
        return None
    seconds = np.array([float(np.median(piece.seconds)) for piece in pieces])
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
