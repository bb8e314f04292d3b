"""Fewer triangles for the same surface: quadric error metrics."""

from typing import Any

import numpy as np

from stillmap.extras import extra
from stillmap.surface.mesh import Mesh

_ROUNDS = 100


def thinned(mesh: Mesh, error: float, *, whole_border: bool = True) -> Mesh:
    """The mesh with fewer triangles; none is turned over.

    Garland and Heckbert, "Surface Simplification Using Quadric Error Metrics", SIGGRAPH 1997.

    Args:
        mesh: welded.
        error: metres by which it may move.
        whole_border: keep each vertex on the border.
    """
    if not len(mesh) or error <= 0.0:
        return mesh
    pyfqmr: Any = extra("pyfqmr", "mesh.glb", "made", group="mesh")
    work = pyfqmr.Simplify()
    work.setMesh(mesh.vertices, mesh.faces)
    work.simplify_mesh(
        lossless=True,
        threshold_lossless=error * error,
        max_iterations=_ROUNDS,
        preserve_border=whole_border,
        verbose=False,
    )
    vertices, faces, _ = work.getMesh()
    return Mesh(np.array(vertices, np.float64), np.array(faces, np.int32).reshape(-1, 3))
