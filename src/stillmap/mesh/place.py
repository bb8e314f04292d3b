"""The place without its people: a surface, and for each face the picture that paints it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stillmap.core.camera import project
from stillmap.core.parallel import in_order
from stillmap.mesh.inputs import Sources
from stillmap.mesh.options import ChoiceOptions, VisibleOptions
from stillmap.mesh.simplification import divided
from stillmap.mesh.texture.exposure import gains
from stillmap.mesh.texture.occluders import Thing, at_time, in_the_way, within_or_behind
from stillmap.mesh.texture.occlusion import Beams, told
from stillmap.mesh.texture.view_selection import (
    Candidates,
    agreeing,
    chosen,
    colours_of_faces,
    utility,
)
from stillmap.mesh.texture.views import View, colours_of
from stillmap.mesh.texture.visibility import visible
from stillmap.mesh.triangle_mesh import Mesh

Float = NDArray[np.float64]
Index = NDArray[np.int32]
Tell = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class Painted:
    """A surface of F faces, and which of N views paints each.

    Attributes:
        mesh: the surface, its long edges divided.
        view: (F,) number of the view; -1: none sees it without something that moves before it.
        p_static: (F,) how probably that view shows static things only; 0 where there is none.
        seen: (F,) whether any view sees it at all.
        sharpest: (F,) number of the view that shows it in most pixels, whatever stands before it.
        p_sharpest: (F,) how probably that one shows static things only.
    """

    mesh: Mesh
    view: Index
    p_static: NDArray[np.float32]
    seen: NDArray[np.bool_]
    sharpest: Index
    p_sharpest: NDArray[np.float32]


def painted(
    mesh: Mesh,
    views: Sequence[View],
    sources: Sources,
    options: ChoiceOptions,
    limits: VisibleOptions,
    threads: int = 1,
    tell: Tell | None = None,
) -> tuple[Painted, Float]:
    """Chooses for each face the view that most likely shows static things only (Sect. 4.4).

    Args:
        mesh: what stands still.
        views: pictures and where they were taken.
        sources: the beams that tell what moves, and when.
        options: see ChoiceOptions.
        limits: see VisibleOptions.
        threads: same result with any number.
        tell: called with how many views are looked at, and of how many.

    Returns:
        What paints each face; (N, 3) by which colours of N views are multiplied to be of one
        exposure.
    """
    if views:
        mesh, _ = divided(mesh, partial(longest_edge, views, options))
    beams, areas = sources.beams(), mesh.areas()
    candidates = Candidates.none(len(mesh), min(options.candidates, max(len(views), 1)))
    sharpest = Candidates.none(len(mesh), 1)

    def looked_at(view: View) -> tuple[NDArray[np.intp], Float, Float]:
        found = visible(mesh, view, limits)
        faces = np.flatnonzero(found.seen)
        p = np.zeros(0)
        if len(faces):
            p = shown(mesh, faces, view, beams, sources.things, options)
        return faces, found.pixels[faces].astype(np.float64), p

    for number, (faces, pixels, p) in enumerate(in_order(looked_at, views, threads)):
        candidates.add(number, faces, utility(p, pixels, areas[faces], options), p)
        sharpest.add(number, faces, pixels, p)
        if tell is not None:
            tell(number + 1, len(views))
    images, gain = sources.recording.images, np.ones((len(views), 3))
    if views and images is not None and (options.level or (options.believe and options.odd > 0.0)):
        found = colours_of_faces(mesh, candidates, views, partial(colours_of, images))
        if options.level:
            gain = gains(candidates.picture, found, len(views))
            found *= gain[candidates.picture]  # of no picture, NaN stays
        if options.believe and options.odd > 0.0:
            candidates = agreeing(candidates, found, options.odd)
    return settled(mesh, candidates, sharpest, options.border), gain


def longest_edge(views: Sequence[View], options: ChoiceOptions, points: Float) -> Float:
    """(n,) metres, how long edges may be that end at points (n, 3).

    `edge` metres, and where the nearest camera is far what is `edge_pixels` wide in its pictures.
    """
    away, nearest = cKDTree(np.array([view.place for view in views])).query(points)
    focal = np.array([0.0 if view.camera.K is None else view.camera.K[0, 0] for view in views])
    wide = options.edge_pixels * away / np.maximum(focal[nearest], 1.0)
    return np.asarray(np.maximum(options.edge, wide), np.float64)


def settled(mesh: Mesh, candidates: Candidates, sharpest: Candidates, border: float) -> Painted:
    """What paints each face once neighbours have settled.

    Args:
        mesh: F faces.
        candidates: the best views of each.
        sharpest: of each the one that shows it in most pixels.
        border: what it costs where two views meet.
    """
    view = chosen(candidates, mesh.pairs(), border)
    p_static = np.where(candidates.picture == view[:, None], candidates.p_static, 0.0).max(axis=1)
    return Painted(
        mesh,
        view,
        np.where(view >= 0, p_static, 0.0).astype(np.float32),
        sharpest.picture[:, 0] >= 0,
        sharpest.picture[:, 0],
        sharpest.p_static[:, 0],
    )


def shown(
    mesh: Mesh,
    faces: NDArray[np.intp],
    view: View,
    beams: Beams,
    things: Sequence[Thing],
    options: ChoiceOptions,
) -> Float:
    """(n,) how probably a view shows static things only where it sees faces (n,).

    By what beams taken about then say, and where there are none by whether a thing that is followed
    stands before it; where one does, nothing behind it speaks against that. Of the corners of a
    face and its middle the least counts.
    """
    part = mesh.part_of(faces)
    points = np.concatenate([part.vertices, part.centres])
    seconds = 1e-9 * (view.stamp_ns - beams.start_ns)
    there = at_time(things, seconds)
    free = 1.0 - in_the_way(there, view.place, points, options.margin, options.sigma)
    ends, p_static = beams.about(view.stamp_ns, options)
    # a laser sees past a thing what the camera beside it does not see
    speaks = (p_static < 0.5) | ~within_or_behind(there, view.place, ends)
    found = told(view, ends[speaks], p_static[speaks], options.margin)
    local = view.in_camera(points)
    uv, ok = project(view.camera, local)
    uv = np.where(ok[:, None], uv, 0.0)  # corners just outside: as at the edge
    p = found.shown(uv, local[:, 2], options.margin, options.unseen * free)
    a, b, c = (p[part.faces[:, k]] for k in range(3))
    return np.minimum(np.minimum(a, b), np.minimum(c, p[len(part.vertices) :]))
