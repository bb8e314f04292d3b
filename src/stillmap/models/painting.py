"""Which pictures paint what moved: those in which it, and nothing else, is seen (Fig. 13)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from stillmap.models.movers import Shape
from stillmap.models.options import MoverOptions
from stillmap.models.place import Painted, settled
from stillmap.surface.dividing import divided
from stillmap.surface.mesh import Mesh
from stillmap.texture.choice import NONE, Candidates, utility
from stillmap.texture.choice_options import ChoiceOptions
from stillmap.texture.lens import project, rays, within
from stillmap.texture.options import VisibleOptions
from stillmap.texture.things import Thing, at_time, in_the_way
from stillmap.texture.view import View
from stillmap.texture.visible import Depths, depths_of, ideal, visible

Float = NDArray[np.float64]

_BEHIND = 0.1  # m by which a surface may lie before a thing and be taken for its own
_LEAST = 1e-9
_SCRAPS = 0.05  # of its area: less is no picture of it
_SMALL = 320.0  # pixels across in which it is seen what of the place hides a thing
_EDGE = 16  # rays along an edge of a picture that tell what it holds
_NO_FACES = np.zeros((0, 0), np.int32)


@dataclass(frozen=True, eq=False)
class Dressed:
    """A moving thing's surface and what paints it, in the thing's own frame.

    Attributes:
        painted: its faces, and which of `views` paints each.
        views: pictures, as if the thing had stood still: `T_camera_map` is T_camera_object.
    """

    painted: Painted
    views: list[View]


class Ahead:
    """How far away what stands still is in views, each looked at once."""

    def __init__(self, place: Mesh, views: Sequence[View], limits: VisibleOptions) -> None:
        self._place, self._views, self._limits = place, views, limits
        self._known: dict[int, Depths] = {}

    def free(self, number: int, points: Float) -> NDArray[np.bool_]:
        """(n,) whether nothing of it lies before points (n, 3) in the map frame, in a view."""
        view = self._views[number]
        at = view.in_camera(points)
        free = at[:, 2] > self._limits.near
        if not free.any() or not len(self._place):
            return free
        if number not in self._known:
            self._known[number] = self._whole(view)
        depths = self._known[number]
        free[free] = _looked_up(depths.depth, depths, at[free]) > at[free, 2] - _BEHIND
        return free

    def _whole(self, view: View) -> Depths:
        """A small z-buffer of all that a view shows."""
        camera = view.camera
        across, down = np.meshgrid(
            np.linspace(0, camera.width - 1, _EDGE), np.linspace(0, camera.height - 1, _EDGE)
        )
        shown = rays(camera, np.column_stack([across.ravel(), down.ravel()]))
        shown = shown[np.isfinite(shown).all(axis=1)]
        scale = min(_SMALL / camera.width, self._limits.scale)
        depths = depths_of(self._place, view, shown, scale, self._limits.near)
        return replace(depths, face=_NO_FACES)


def when_in_view(thing: Thing, views: Sequence[View], start_ns: int) -> Float:
    """(N,) s, when views show the middle of a thing, by the time of its box; NaN: not."""
    seconds = np.array([1e-9 * (view.stamp_ns - start_ns) for view in views])
    out = np.full(len(views), np.nan)
    for k, (view, now) in enumerate(zip(views, seconds.tolist(), strict=True)):
        for cuboid in at_time([thing], now):
            uv, ok = project(view.camera, view.in_camera(cuboid.middle[None]))
            if ok[0] and within(view.camera, uv)[0]:
                out[k] = now
    return out


def dressed(
    shape: Shape,
    views: Sequence[View],
    place: Ahead,
    things: Sequence[Thing],
    start_ns: int,
    options: MoverOptions,
    choice: ChoiceOptions,
    limits: VisibleOptions,
) -> Dressed:
    """Chooses for each face of what moved the view that shows it best.

    A view may paint a face if the place does not hide it, if no other thing is likely to, and if it
    lies within the thing's outline by `options.rim`, and more with time: beside that it shows what
    is behind.

    Args:
        shape: the thing.
        views: pictures and where they were taken, in the map frame.
        place: what stands still, of the same views.
        things: all that moves, this one too.
        start_ns: when the time of the things begins.
        options, choice, limits: see there.
    """
    mesh, _ = divided(shape.mesh, min(choice.edge, options.edge))
    candidates = Candidates.none(len(mesh), choice.candidates)
    sharpest, own = Candidates.none(len(mesh), 1), list[View]()
    others = [one for one in things if one.box.thing != shape.id]
    seconds = when_in_view(shape.way.thing, views, start_ns)
    for number, (view, now) in enumerate(zip(views, seconds.tolist(), strict=True)):
        away = max(shape.span[0] - now, now - shape.span[1], 0.0)
        if np.isnan(now) or (not shape.rigid and away > options.near):
            continue
        T_map_object = shape.way.T_map_object(now)
        rim = options.rim + options.drift * (0.0 if shape.rigid else _gone(shape, now))
        moved = replace(view, T_camera_map=view.T_camera_map @ T_map_object)
        found = visible(mesh, moved, limits)
        faces = np.flatnonzero(found.seen)
        faces = faces[_inside(mesh, faces, moved, rim, limits)]
        if not len(faces):
            continue
        points = mesh.centres[faces] @ T_map_object[:3, :3].T + T_map_object[:3, 3]
        free = place.free(number, points)
        faces, points = faces[free], points[free]
        hidden = in_the_way(at_time(others, now), view.place, points, choice.margin, choice.sigma)
        pixels = found.pixels[faces].astype(np.float64)
        good = utility(1.0 - hidden, pixels, mesh.areas()[faces], replace(choice, believe=True))
        if not shape.rigid:  # who walks looks otherwise a moment later
            good -= away / max(options.near, _LEAST)
        candidates.add(len(own), faces, good, 1.0 - hidden)
        sharpest.add(len(own), faces, pixels, 1.0 - hidden)
        own.append(moved)
    painted = settled(mesh, candidates, sharpest, choice.border)
    areas = mesh.areas()
    if areas[painted.view >= 0].sum() < _SCRAPS * areas.sum():
        painted = replace(painted, view=np.full_like(painted.view, NONE))
    return Dressed(painted, own)


def _gone(shape: Shape, seconds: float) -> float:
    """Metres that a thing went from when its shape was seen to a time."""
    there = shape.way.thing.box.middle(np.array([shape.seconds, seconds]))
    return float(np.linalg.norm(there[1] - there[0]))


def _inside(
    mesh: Mesh, faces: NDArray[np.intp], view: View, rim: float, limits: VisibleOptions
) -> NDArray[np.bool_]:
    """(n,) whether faces (n,) lie within the outline of a mesh by `rim` metres."""
    if not len(faces):
        return np.zeros(0, np.bool_)
    points = view.in_camera(mesh.vertices)
    depths = depths_of(mesh, view, points[np.unique(mesh.faces[faces])], limits.scale, limits.near)
    far = ndimage.distance_transform_edt(np.pad(depths.face >= 0, 1))[1:-1, 1:-1]
    at = np.concatenate([points[mesh.faces[faces]], points[mesh.faces[faces]].mean(1)[:, None]], 1)
    metres = _looked_up(far, depths, at) * at[..., 2] / depths.K[0, 0]
    return np.asarray(metres.min(axis=1) >= rim)


def _looked_up(values: NDArray[np.floating], depths: Depths, at: Float) -> Float:
    """(...,) what an image (h, w) has where points (..., 3) of the camera's frame are seen."""
    h, w = values.shape
    column, row = (np.rint(a).astype(np.intp) for a in ideal(depths.K, at.reshape(-1, 3).T))
    found = values[np.clip(row, 0, h - 1), np.clip(column, 0, w - 1)]
    return np.asarray(found.reshape(at.shape[:-1]), np.float64)
