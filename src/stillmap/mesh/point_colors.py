"""Colours of the beams' end points: of what stands still as the surface there is painted, of what
moves from pictures taken about when it was seen.

Points on what moves, and their colours: of pictures taken about when they were seen.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays
from stillmap.core.camera import project
from stillmap.core.chunks import Chunk, iter_chunks
from stillmap.core.parallel import map_ordered
from stillmap.mapping.beam_statistics import DYNAMIC_BELOW
from stillmap.mesh.background import Background
from stillmap.mesh.inputs import MeshInputs
from stillmap.mesh.objects.segmentation import NO_OWNER, DynamicReturns
from stillmap.mesh.options import MeshOptions
from stillmap.mesh.texture.atlas import GRAY, TexturedMesh
from stillmap.mesh.texture.baking import sample_bilinear
from stillmap.mesh.texture.occluders import OrientedBox, TrackedBox, boxes_at, occlusion_probability
from stillmap.mesh.texture.point_colors import TextureSampler, avoid_gray, outline_depth
from stillmap.mesh.texture.views import View

Tell = Callable[[int, int], None]

Float = NDArray[np.float64]

Bool = NDArray[np.bool_]

Colours = NDArray[np.uint8]


class _Seen(NamedTuple):
    """n beams on things that move, taken about a time.

    Attributes:
        beam: (n,) their numbers.
        ends: (n, 3) metres in the map frame, where they ended.
        seconds: (n,) when, by the time of the things.
        owner: (n,) of which thing each is, by its place among `things`.
    """

    beam: NDArray[np.intp]
    ends: Float
    seconds: Float
    owner: NDArray[np.intp]


class TrackedReturns:
    """The dynamic beams on things that are followed, to be asked for by time."""

    def __init__(self, sources: MeshInputs, moves: DynamicReturns) -> None:
        self.sources = sources
        place = {one.box.object_id: number for number, one in enumerate(sources.boxes)}
        ids, of = np.unique(moves.owner, return_inverse=True)
        owner = np.array([place.get(int(one), NO_OWNER) for one in ids], np.intp)[of]
        kept = np.flatnonzero(moves.is_dynamic & (owner != NO_OWNER))
        kept = kept[np.argsort(moves.seconds[kept], kind="stable")]
        self._all = _Seen(moves.beam[kept], moves.ends[kept], moves.seconds[kept], owner[kept])

    def near_time(self, now: float, near: float) -> _Seen:
        """Those that ended within `near` seconds of a time."""
        seen = self._all
        first = int(np.searchsorted(seen.seconds, now - near))
        last = int(np.searchsorted(seen.seconds, now + near, side="right"))
        then = slice(first, last)
        return _Seen(seen.beam[then], seen.ends[then], seen.seconds[then], seen.owner[then])


def color_moving(
    out: Colours,
    late: NDArray[np.float32],
    moving: TrackedReturns,
    number: int,
    place: Background,
    options: MeshOptions,
) -> None:
    """Colours what moves and is seen in a picture, where none nearer in time shows it.

    Args:
        out: (M, 3), changed.
        late: (M,) s from each beam to the picture that it has its colour from; changed.
        moving: the dynamic beams.
        number: of the view.
        place: what stands still, which hides what is behind it.
        options: see MeshOptions.
    """
    sources, limits = moving.sources, options.texture.visible
    view = place.views[number]
    now = 1e-9 * (view.stamp_ns - sources.start_ns)
    seen = moving.near_time(now, options.objects.near)
    away = np.abs(seen.seconds - now).astype(np.float32)
    ends = _carried(seen, sources.boxes, now)
    local = view.to_camera(ends)
    uv, ok = project(view.camera, local)
    size, m = np.array([view.camera.width, view.camera.height]), limits.margin
    with np.errstate(invalid="ignore"):  # NaN: nowhere
        ok &= ((uv >= m) & (uv <= size - 1.0 - m)).all(axis=1)
    ok &= local[:, 2] > limits.near
    ok &= _within_outlines(seen, local, ok, sources.boxes, now, options)
    ok &= away < late[seen.beam]
    shown = np.flatnonzero(ok)
    shown = shown[place.is_unoccluded(number, ends[shown])] if len(shown) else shown
    shown = shown[_free(ends[shown], seen.owner[shown], sources.boxes, view, now, options)]
    if not len(shown):
        return
    picture = place.image(number)
    if picture is None:
        return
    colours = np.rint(sample_bilinear(np.ascontiguousarray(picture[..., :3]), uv[shown]))
    out[seen.beam[shown]] = avoid_gray(colours.astype(np.uint8))
    late[seen.beam[shown]] = away[shown]


def _carried(seen: _Seen, things: Sequence[TrackedBox], now: float) -> Float:
    """(n, 3) where the ends are once each has gone on with its thing to a time."""
    out = seen.ends.copy()
    for number in np.unique(seen.owner).tolist():
        mine, box = seen.owner == number, things[number].box
        out[mine, :2] += box.center_at(np.array([now])) - box.center_at(seen.seconds[mine])
    return out


def _within_outlines(
    seen: _Seen,
    local: Float,
    shown: Bool,
    things: Sequence[TrackedBox],
    now: float,
    options: MeshOptions,
) -> Bool:
    """(n,) whether points that are shown lie within the outline of their thing in a picture.

    By `mesh.points.rim`, and by `mesh.objects.drift` of the way that it went since.

    Args:
        seen: the beams.
        local: (n, 3) metres in the camera's frame, where they have gone on to.
        shown: (n,) whether they are in the picture.
        things: all that moves.
        now: s, when the picture was taken, by their time.
        options: see MeshOptions.
    """
    out = np.zeros(len(shown), np.bool_)
    for number in np.unique(seen.owner[shown]).tolist():
        mine = np.flatnonzero(shown & (seen.owner == number))
        x, y, z = local[mine].T
        inside = outline_depth(
            np.stack([x / z, y / z], axis=1) * np.median(z), options.points.apart
        )
        box = things[number].box
        way = box.center_at(np.array([now])) - box.center_at(seen.seconds[mine])
        gone = np.linalg.norm(way, axis=1)
        out[mine] = inside >= options.points.rim + options.objects.drift * gone
    return out


def _free(
    points: Float,
    owner: NDArray[np.intp],
    things: Sequence[TrackedBox],
    view: View,
    now: float,
    options: MeshOptions,
) -> Bool:
    """(n,) whether probably no other thing stands between a camera and points.

    What is in a thing's box, or near, is taken for a part of it.
    """
    choice, free = options.choice, np.ones(len(points))
    for number, thing in enumerate(things):
        for cuboid in boxes_at([thing], now):
            mine = (owner == number) | _inside(cuboid, points, choice.margin)
            rest = np.flatnonzero(~mine)
            hidden = occlusion_probability(
                [cuboid], view.position, points[rest], choice.margin, choice.sigma
            )
            free[rest] *= 1.0 - hidden
    return free >= choice.least


def _inside(cuboid: OrientedBox, points: Float, margin: float) -> Bool:
    return np.asarray((np.abs(cuboid.local(points)) <= cuboid.half_size + margin).all(axis=1))


_TOGETHER = 1 << 16  # points


@dataclass(frozen=True, eq=False)
class PointColors:
    """Colours of the ends of M beams.

    Attributes:
        colours: (M, 3) uint8, as photographed (sRGB); GREY where no picture tells, and only there.
        counts: numbers of hits, `static` and `dynamic`, and how many of them have a colour:
            `static_coloured`, `dynamic_coloured`.
    """

    colors: Colours
    counts: dict[str, int]


def color_points(
    sources: MeshInputs,
    textured: TexturedMesh,
    place: Background,
    moves: DynamicReturns,
    options: MeshOptions,
    threads: int = 1,
    tell: Tell | None = None,
) -> PointColors:
    """The colour of each beam's end.

    What lies on the surface of the place has the colour that is painted there: of a picture that
    probably shows nothing that moves before it. What moves is carried along its track to the time
    of pictures `mesh.objects.near` seconds from then at most; of those that show it the nearest in
    time counts. What is of no track has none.

    Args:
        sources: M beams.
        textured: the surface of the place.
        place: what stands still, and the pictures that can be used.
        moves: the beams on what moves.
        options: see MeshOptions.
        threads: same result with any number.
        tell: called with what is done, and how much of it.
    """
    recording = sources.recording
    out: Colours = recording.allocate_per_beam(np.uint8, (3,))
    scans, n = recording.n_scans, recording.n_scans + len(place.views)
    painted = TextureSampler(textured, options.points.off)
    T_map_sensor = sources.deskewed.T_map_sensor(sources.poses)
    for chunk in iter_chunks(sources.deskewed, release=[sources.p_static, out]):
        out[chunk.beams] = GRAY
        _tint_static(out, chunk, sources, T_map_sensor, painted, threads)
        if tell is not None:
            tell(chunk.scans.stop, n)
    late = recording.allocate_per_beam(np.float32)
    for block in arrays.iter_blocks(late):
        late[block] = np.inf
    moving = TrackedReturns(sources, moves)
    for number in range(len(place.views)):
        color_moving(out, late, moving, number, place, options)
        sources.deskewed.release_pages(sources.p_static, out, late)
        if tell is not None:
            tell(scans + number + 1, n)
    return PointColors(out, _counts(out, sources))


def _counts(colours: Colours, sources: MeshInputs) -> dict[str, int]:
    hit, p_static = sources.deskewed.hit, sources.p_static
    out = dict.fromkeys(("static", "static_coloured", "dynamic", "dynamic_coloured"), 0)
    for block in arrays.iter_blocks(hit, p_static, colours):
        has, still = (colours[block] != GRAY).any(axis=1), p_static[block] >= DYNAMIC_BELOW
        for name, part in (("static", hit[block] & still), ("dynamic", hit[block] & ~still)):
            out[name] += int(np.count_nonzero(part))
            out[f"{name}_coloured"] += int(np.count_nonzero(part & has))
    return out


def _tint_static(
    out: Colours,
    chunk: Chunk,
    sources: MeshInputs,
    T_map_sensor: Float,
    painted: TextureSampler,
    threads: int,
) -> None:
    """Colours what stands still of some scans."""
    beams = chunk.beams
    still = sources.deskewed.hit[beams] & (sources.p_static[beams] >= DYNAMIC_BELOW)
    numbers = np.flatnonzero(still)
    scan = np.searchsorted(chunk.offset, numbers, side="right") - 1 + chunk.scans.start
    parts = [slice(k, k + _TOGETHER) for k in range(0, len(numbers), _TOGETHER)]

    def found(part: slice) -> tuple[slice, Colours, Bool]:
        T = T_map_sensor[scan[part]]
        local = sources.deskewed.points[beams.start + numbers[part]].astype(np.float64)
        ends = np.einsum("nij,nj->ni", T[:, :3, :3], local) + T[:, :3, 3]
        return part, *painted.colors(ends, T[:, :3, 3])

    for part, colours, has in map_ordered(found, parts, threads):
        out[beams.start + numbers[part][has]] = colours[has]
