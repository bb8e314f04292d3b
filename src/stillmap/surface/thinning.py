"""Fewer triangles for the same surface: quadric error metrics."""

from typing import Any

import numpy as np

from stillmap.extras import extra
from stillmap.surface.mesh import Mesh

_ROUNDS = 20  # in which the error that is let pass grows to what is allowed
_GROWTH = 3.0  # with this power
_FIRST = 3.0  # the round with which it begins
_AGAIN = 2.0  # times as much error is allowed next, while there are too many triangles
_MOST = 24  # times
_LITTLE = 0.9  # of the triangles left: more error does not help


def thinned(mesh: Mesh, error: float, *, whole_border: bool = True, most: int = 0) -> Mesh:
    """The mesh with fewer triangles; none is turned over.

    Garland and Heckbert, "Surface Simplification Using Quadric Error Metrics", SIGGRAPH 1997.

    Args:
        mesh: welded.
        error: metres, root of the sum of squared distances from the planes around that a vertex
            may have.
        whole_border: keep each vertex on the border.
        most: triangles that are enough; as few as the error allows in any case if 0.
    """
    if len(mesh) <= most or not len(mesh) or error <= 0.0:
        return mesh
    pyfqmr: Any = extra("pyfqmr", "mesh.glb", "made", group="mesh")
    work = pyfqmr.Simplify()
    work.setMesh(mesh.vertices, mesh.faces)
    work.simplify_mesh(
        target_count=most,
        max_iterations=_ROUNDS,
        aggressiveness=_GROWTH,
        K=_FIRST,
        alpha=error * error / (_ROUNDS + _FIRST) ** _GROWTH,
        preserve_border=whole_border,
        verbose=False,
    )
    vertices, faces, _ = work.getMesh()
    return Mesh(np.array(vertices, np.float64), np.array(faces, np.int32).reshape(-1, 3))


def within_budget(mesh: Mesh, error: float, most: int, *, whole_border: bool = False) -> Mesh:
    """The mesh with so many triangles at most, whatever the error; borders go last.

    With `whole_border` they stay, and there may be more triangles.
    """
    for _ in range(_MOST):
        before = len(mesh)
        if before <= most:
            break
        error *= _AGAIN
        mesh = thinned(mesh, error, most=most)
        if not whole_border:
            # before the surface goes, which would have to make up for ragged borders
            mesh = thinned(mesh, error, whole_border=False, most=most)
        elif len(mesh) > _LITTLE * before:
            break
    return mesh
