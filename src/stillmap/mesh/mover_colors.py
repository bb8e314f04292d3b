"""Colors of moving objects from images in which the object, and nothing else, is seen (Fig. 13);
colors of all end points, static ones from the textured surface."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import ndimage

from stillmap.core import arrays
from stillmap.core.array_types import Bool, Float, Float32, Index
from stillmap.core.camera import is_in_image, project
from stillmap.core.chunks import Chunk, iter_chunks
from stillmap.core.parallel import map_ordered
from stillmap.em.types import DYNAMIC_BELOW
from stillmap.mesh.inputs import (
    OUTLINE_MARGIN,
    MeshInputs,
    TrackedBox,
    boxes_at,
    occlusion_probability,
)
from stillmap.mesh.place import Background, ViewAssignment, resolve_assignment
from stillmap.mesh.reconstruction import IMAGE_WINDOW, ObjectShape
from stillmap.mesh.returns import DynamicReturns
from stillmap.mesh.texture import GRAY, TexturedMesh, TextureSampler, avoid_gray, sample_bilinear
from stillmap.mesh.triangle_mesh import Image, Tell, no_tell, subdivide
from stillmap.mesh.view_selection import MIN_P_VISIBLE, NONE, Candidates, view_utility
from stillmap.mesh.views import View
from stillmap.mesh.visibility import NEAR, find_visible_faces, project_inside

_OUTLINE_CELL = 0.01  # m
_MAX_OUTLINE_CELLS = 1 << 10  # along an edge, beyond which cells are larger
OUTLINE_DRIFT = 0.05  # of an object's motion since its observation: error of its outline
_OUTLINE_INSET = 0.01  # m inside an object's outline, where an image may show the background
_UNCERTAIN_INSET = 0.08  # m more where the background is unknown
_MIN_BACKGROUND_DIFFERENCE = 30.0  # of 442, of colors from those of the background
_MIN_VISIBLE_SHARE = 0.8  # of an object's faces in a view that the background does not hide
_MIN_DIFFERENT_SHARE = 0.8  # of these that differ from the background, where it is known
_MAX_FACE_EDGE = 0.05  # m: longer edges are subdivided
_MIN_TEXTURED_SHARE = 0.05  # of an object's area: less is no texture of it


def times_in_view(box: TrackedBox, views: Sequence[View], start_ns: int) -> Float:
    """(N,) s, times of views that show the center of a box, by its clock; NaN: not."""
    seconds = np.array([1e-9 * (view.stamp_ns - start_ns) for view in views])
    out = np.full(len(views), np.nan)
    for k, (view, now) in enumerate(zip(views, seconds.tolist(), strict=True)):
        for one in boxes_at([box], now):
            uv, ok = project(view.camera, view.to_camera(one.center[None]))
            if ok[0] and is_in_image(view.camera, uv)[0]:
                out[k] = now
    return out


def assign_object_views(
    shape: ObjectShape, background: Background, boxes: Sequence[TrackedBox], start_ns: int
) -> tuple[ViewAssignment, list[View]]:
    """Chooses for each face of a moving object the view that shows it best.

    A view may texture a face if neither the background nor probably another object occludes it, and
    if it lies inside the object's outline by a margin that grows with its motion. Even there the
    background may be seen, as between legs: the view's colors must differ from those that other
    views have of the background. Where these are unknown, a face must lie farther inside.

    Args:
        shape: the object.
        background: the static surface in all views.
        boxes: of all objects, this one too.
        start_ns: stamp at which the seconds of the boxes begin.

    Returns:
        The faces, and which view textures each; the views as if the object had stood still, their
        `T_camera_map` is T_camera_object.
    """
    mesh, _ = subdivide(shape.mesh, _MAX_FACE_EDGE)
    candidates = Candidates.empty(len(mesh))
    own = list[View]()
    others = [one for one in boxes if one.box.object_id != shape.id]
    seconds = times_in_view(shape.frame.box, background.views, start_ns)
    for number, (view, now) in enumerate(zip(background.views, seconds.tolist(), strict=True)):
        away = max(shape.span[0] - now, now - shape.span[1], 0.0)
        if np.isnan(now) or (not shape.rigid and away > IMAGE_WINDOW):
            continue
        T_map_object = shape.frame.T_map_object(now)
        moved = replace(view, T_camera_map=view.T_camera_map @ T_map_object)
        all_pixels = find_visible_faces(mesh, moved)
        faces = np.flatnonzero(all_pixels)
        (travel,) = shape.frame.box.motion_until(now, np.array([shape.seconds]))
        drift = 0.0 if shape.rigid else OUTLINE_DRIFT * float(np.linalg.norm(travel))
        corners = moved.to_camera(mesh.vertices)
        depth = np.zeros(len(corners))
        depth[corners[:, 2] > NEAR] = outline_depth(corners[corners[:, 2] > NEAR], _MAX_FACE_EDGE)
        depth = depth[mesh.faces[faces]].min(axis=1, initial=np.inf) - (_OUTLINE_INSET + drift)
        points = mesh.centers[faces] @ T_map_object[:3, :3].T + T_map_object[:3, 3]
        kept = _shows_object(points, depth, number, background)
        faces, points = faces[kept], points[kept]
        if not len(faces):
            continue
        p_free = 1.0 - occlusion_probability(boxes_at(others, now), view.position, points)
        pixels = all_pixels[faces].astype(np.float64)
        utility = view_utility(p_free, pixels, mesh.areas()[faces])
        if not shape.rigid:  # people change their shape
            utility -= away / IMAGE_WINDOW
        candidates.add(len(own), faces, utility, p_free)
        own.append(moved)
    assignment = resolve_assignment(mesh, candidates)
    areas = mesh.areas()
    if areas[assignment.view >= 0].sum() < _MIN_TEXTURED_SHARE * areas.sum():
        assignment = replace(assignment, view=np.full_like(assignment.view, NONE))
    return assignment, own


def _shows_object(points: Float, depth: Float, number: int, background: Background) -> Bool:
    """(n,) whether a view shows an object, and not the background, at map points (n, 3).

    They lie `depth` (n,) metres farther inside its outline than they need to. Where the background
    hides much of the object, errors of the edge that hides it matter; where much of it has the
    colors of the background, the object is elsewhere: such a view shows none of it.
    """
    shown = depth >= 0.0
    inside = np.count_nonzero(shown)
    shown[shown] = background.is_unoccluded(number, points[shown])
    if np.count_nonzero(shown) < max(_MIN_VISIBLE_SHARE * inside, 1.0):
        return np.zeros_like(shown)
    difference = background.color_difference(number, points[shown])
    differs = difference >= _MIN_BACKGROUND_DIFFERENCE
    unknown = np.isnan(difference)
    if np.count_nonzero(differs) < _MIN_DIFFERENT_SHARE * np.count_nonzero(~unknown):
        return np.zeros_like(shown)
    shown[shown] = differs | (unknown & (depth[shown] >= _UNCERTAIN_INSET))
    return shown


def outline_depth(points: Float, radius: float) -> Float:
    """(n,) metres from points (n, 3) to the outline of the area that they cover; 0: on it.

    The area is the union of discs around the points in the image, holes filled, eroded by the same
    radius.

    Args:
        points: metres in the camera's frame, in front of it.
        radius: metres of the discs, at the median depth.
    """
    if not len(points):
        return np.zeros(0)
    points = points[:, :2] * (np.median(points[:, 2]) / points[:, 2:])
    cell = max(_OUTLINE_CELL, float(np.ptp(points, axis=0).max()) / _MAX_OUTLINE_CELLS)
    at = np.floor(points / cell).astype(np.int64)
    border = int(np.ceil(radius / cell)) + 2
    at -= at.min(axis=0) - border
    empty = np.ones(at.max(axis=0) + border + 1, np.bool_)
    empty[at[:, 0], at[:, 1]] = False
    covered = ndimage.distance_transform_edt(empty) * cell <= radius
    away = ndimage.distance_transform_edt(ndimage.binary_fill_holes(covered)) * cell
    return np.asarray(np.maximum(away[at[:, 0], at[:, 1]] - cell - radius, 0.0))


_MAX_SURFACE_DISTANCE = 0.1  # m of a static point from the surface
_POINT_INSET = 0.02  # m inside an object's outline, where an image may show the background
_POINT_RADIUS = 0.12  # m around each point that an object covers
_POINTS_PER_BLOCK = 1 << 16


def color_points(
    textured: TexturedMesh,
    background: Background,
    returns: DynamicReturns,
    threads: int = 1,
    tell: Tell = no_tell,
) -> Image:
    """(M, 3) sRGB colors of the end points of all beams; GRAY where unknown, and only there.

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
    for box in inputs.boxes:
        mine = np.flatnonzero(seen.owner == box.box.object_id)
        if not len(mine):
            continue
        ends, uv, shown = _find_shown(seen.take(mine), box, view, now)
        shown &= away[mine] < delay[seen.beam[mine]]
        shown[shown] = background.is_unoccluded(number, ends[shown])
        mine, ends, uv = mine[shown], ends[shown], uv[shown]
        free = np.ones(len(ends))
        for other in boxes_at([one for one in inputs.boxes if one is not box], now):
            # points in the box of another object, or near it, may be its own
            within = (np.abs(other.local(ends)) <= other.half_size + OUTLINE_MARGIN).all(axis=1)
            hidden = occlusion_probability([other], view.position, ends[~within])
            free[~within] *= 1.0 - hidden
        mine, uv = mine[free >= MIN_P_VISIBLE], uv[free >= MIN_P_VISIBLE]
        if len(mine):
            colors = np.rint(sample_bilinear(background.image(number), uv)).astype(np.uint8)
            out[seen.beam[mine]] = avoid_gray(colors)
            delay[seen.beam[mine]] = away[mine]


def _find_shown(
    seen: DynamicReturns, box: TrackedBox, view: View, now: float
) -> tuple[Float, Float, Bool]:
    """End points (n, 3) on an object, moved with it to a time, and their pixels (n, 2) in a view;
    whether (n,) they are in it and within the outline that all of them have there."""
    motion = box.motion_until(now, seen.seconds)
    ends = seen.ends.copy()
    ends[:, :2] += motion
    local = view.to_camera(ends)
    uv, shown = project_inside(view, local)
    shown &= local[:, 2] > NEAR
    inset = _POINT_INSET + OUTLINE_DRIFT * np.linalg.norm(motion, axis=1)
    shown[shown] = outline_depth(local[shown], _POINT_RADIUS) >= inset[shown]
    return ends, uv, shown
