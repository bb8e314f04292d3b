"""Point coloring: static end points take the color of the textured surface, dynamic ones that of
images near their time, into which they are moved along their track."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stillmap.core import arrays
from stillmap.core.array_types import Bool, Float, Float32, Index, Int32
from stillmap.core.chunks import Chunk, iter_chunks
from stillmap.core.parallel import map_ordered
from stillmap.core.short_repr import ShortRepr
from stillmap.em.types import DYNAMIC_BELOW
from stillmap.mesh.inputs import MeshInputs
from stillmap.mesh.place import Background
from stillmap.mesh.reconstruction import IMAGE_WINDOW
from stillmap.mesh.returns import DynamicReturns
from stillmap.mesh.texture import GRAY, TexturedMesh, TextureSampler, avoid_gray, sample_bilinear
from stillmap.mesh.texturing import OUTLINE_DRIFT, outline_depth
from stillmap.mesh.tracked_boxes import OUTLINE_MARGIN, TrackedBox, boxes_at, occlusion_probability
from stillmap.mesh.triangle_mesh import Image, Tell, no_tell
from stillmap.mesh.view_selection import MIN_P_VISIBLE
from stillmap.mesh.views import View
from stillmap.mesh.visibility import NEAR, project_inside

_MAX_SURFACE_DISTANCE = 0.1  # m of a static point from the surface
_OUTLINE_INSET = 0.02  # m inside an object's outline, where an image may show the background
_POINT_RADIUS = 0.12  # m around each point that an object covers
_POINTS_PER_BLOCK = 1 << 16


@dataclass(frozen=True, eq=False)
class PointColors(ShortRepr):
    """Colors of the end points of M beams.

    Attributes:
        colors: (M, 3) uint8, sRGB; GRAY where unknown, and only there.
        counts: numbers of hits, `static` and `dynamic`, and how many of them have a color:
            `static_coloured`, `dynamic_coloured`.
    """

    colors: Image
    counts: dict[str, int]


def color_points(
    textured: TexturedMesh,
    background: Background,
    returns: DynamicReturns,
    threads: int = 1,
    tell: Tell = no_tell,
) -> PointColors:
    """Colors the end points of all beams.

    Dynamic points without a track have no color.

    Args:
        textured: the static surface.
        background: the static surface in the usable images.
        returns: dynamic returns.
        threads: same result with any number.
        tell: called with the scans and images done and the total.
    """
    inputs, recording = returns.inputs, returns.inputs.recording
    out: Image = recording.allocate_per_beam(np.uint8, (3,))
    scans, n = recording.n_scans, recording.n_scans + len(background.views)
    sampler = TextureSampler(textured, _MAX_SURFACE_DISTANCE)
    for chunk in iter_chunks(inputs.deskewed, release=[inputs.p_static, out]):
        out[chunk.beams] = GRAY
        _color_static(out, chunk, inputs, sampler, threads)
        tell(chunk.scans.stop, n)
    delay = recording.allocate_per_beam(np.float32)
    for block in arrays.iter_blocks(delay):
        delay[block] = np.inf
    tracked = returns.tracked()
    for number in range(len(background.views)):
        color_moving(out, delay, tracked, number, background)
        inputs.deskewed.release_pages(inputs.p_static, out, delay)
        tell(scans + number + 1, n)
    return PointColors(out, _count_colored_returns(out, inputs))


def _count_colored_returns(colors: Image, inputs: MeshInputs) -> dict[str, int]:
    hit, p_static = inputs.deskewed.hit, inputs.p_static
    out = dict.fromkeys(("static", "static_coloured", "dynamic", "dynamic_coloured"), 0)
    for block in arrays.iter_blocks(hit, p_static, colors):
        has, static = (colors[block] != GRAY).any(axis=1), p_static[block] >= DYNAMIC_BELOW
        for name, part in (("static", hit[block] & static), ("dynamic", hit[block] & ~static)):
            out[name] += int(np.count_nonzero(part))
            out[f"{name}_coloured"] += int(np.count_nonzero(part & has))
    return out


def _color_static(
    out: Image, chunk: Chunk, inputs: MeshInputs, sampler: TextureSampler, threads: int
) -> None:
    """Colors the static end points of a chunk of scans; in place."""
    beams = chunk.beams
    static = inputs.deskewed.hit[beams] & (inputs.p_static[beams] >= DYNAMIC_BELOW)
    numbers = beams.start + np.flatnonzero(static)
    parts = [numbers[k : k + _POINTS_PER_BLOCK] for k in range(0, len(numbers), _POINTS_PER_BLOCK)]

    def sample(part: Index) -> tuple[Index, Image, Bool]:
        ends = inputs.deskewed.end_points(part, inputs.poses)
        sensors = inputs.T_map_sensor[inputs.deskewed.scans_of(part), :3, 3]
        return part, *sampler.colors(ends, sensors)

    for part, colors, known in map_ordered(sample, parts, threads):
        out[part[known]] = colors[known]


def color_moving(
    out: Image, delay: Float32, tracked: DynamicReturns, number: int, background: Background
) -> None:
    """Colors the tracked points that an image shows, where no image nearer in time does.

    Args:
        out: (M, 3), changed.
        delay: (M,) s from each beam to the image of its color; changed.
        tracked: see `DynamicReturns.tracked`.
        number: of the view.
        background: occludes what is behind it.
    """
    inputs, view = tracked.inputs, background.views[number]
    now = 1e-9 * (view.stamp_ns - inputs.start_ns)
    first, last = np.searchsorted(tracked.seconds, [now - IMAGE_WINDOW, now + IMAGE_WINDOW])
    seen = tracked.take(slice(first, last))
    away = np.abs(seen.seconds - now).astype(np.float32)
    ends, drift = _move_along_tracks(seen, now)
    local = view.to_camera(ends)
    uv, ok = project_inside(view, local)
    ok &= local[:, 2] > NEAR
    ok &= _depth_inside_outline(seen.owner, local, ok) >= _OUTLINE_INSET + OUTLINE_DRIFT * drift
    ok &= away < delay[seen.beam]
    shown = np.flatnonzero(ok)
    shown = shown[background.is_unoccluded(number, ends[shown])]
    shown = shown[_is_unoccluded_by_others(ends[shown], seen.owner[shown], inputs.boxes, view, now)]
    if not len(shown):
        return
    colors = np.rint(sample_bilinear(background.image(number), uv[shown]))
    out[seen.beam[shown]] = avoid_gray(colors.astype(np.uint8))
    delay[seen.beam[shown]] = away[shown]


def _move_along_tracks(seen: DynamicReturns, now: float) -> tuple[Float, Float]:
    """(n, 3) end points, each moved with its object to a time, and (n,) metres of that motion."""
    out, moved = seen.ends.copy(), np.zeros(len(seen.ends))
    boxes = {tracked.box.object_id: tracked for tracked in seen.inputs.boxes}
    for owner in np.unique(seen.owner).tolist():
        mine = seen.owner == owner
        motion = boxes[owner].motion_until(now, seen.seconds[mine])
        out[mine, :2] += motion
        moved[mine] = np.linalg.norm(motion, axis=1)
    return out, moved


def _depth_inside_outline(owner: Int32, local: Float, shown: Bool) -> Float:
    """(n,) metres by which points lie inside the outline of their object in an image.

    Args:
        owner: (n,) object.
        local: (n, 3) metres in the camera's frame, moved to the time of the image.
        shown: (n,) whether they are in the image.
    """
    out = np.full(len(shown), -np.inf)
    for number in np.unique(owner[shown]).tolist():
        mine = np.flatnonzero(shown & (owner == number))
        x, y, z = local[mine].T
        plane = np.stack([x / z, y / z], axis=1) * np.median(z)
        out[mine] = outline_depth(plane, _POINT_RADIUS)
    return out


def _is_unoccluded_by_others(
    points: Float, owner: Int32, boxes: Sequence[TrackedBox], view: View, now: float
) -> Bool:
    """(n,) whether probably no other object stands between a camera and points (n, 3).

    Points in an object's box, or near it, count as its own.
    """
    free = np.ones(len(points))
    for tracked in boxes:
        for box in boxes_at([tracked], now):
            within = (np.abs(box.local(points)) <= box.half_size + OUTLINE_MARGIN).all(axis=1)
            rest = np.flatnonzero((owner != tracked.box.object_id) & ~within)
            free[rest] *= 1.0 - occlusion_probability([box], view.position, points[rest])
    return free >= MIN_P_VISIBLE
