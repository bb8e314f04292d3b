"""Models as `stillmap map` writes them, read to be scored."""

import model_surface
import numpy as np
import pytest
from model_readers import read_glb

from stillmap.mesh.texture import TexturedMesh
from stillmap.results.gltf import write_glb

pytest.importorskip("trimesh")


def test_colours_stay_where_they_are(tmp_path):
    """A slanting square, red along its u and green along its v, beside a grey face."""
    uv = np.array([(0.0, 0.0), (1, 0), (1, 1), (0, 1), (0, 0)])
    corner, along, up = np.array([1.0, 2, 3]), np.array([2.0, 0, 0.5]), np.array([0, 1.0, 1.5])
    vertices = corner + uv[:, :1] * along + uv[:, 1:] * up
    vertices[4] = (1, 1, 1)
    n = 64
    level = np.rint((np.arange(n) + 0.5) / n * 255)
    red, green = np.meshgrid(level, level)
    page = np.stack([red, green, np.zeros_like(red)], axis=-1).astype(np.uint8)
    model = TexturedMesh(
        vertices,
        np.array([(0, 1, 2), (0, 2, 3), (0, 1, 4)], np.int32),
        uv,
        np.array([0, 0, -1], np.int32),
        (page,),
        np.array([0, 0, -1], np.int32),
    )
    write_glb(tmp_path / "mesh.glb", model)
    found = read_glb(tmp_path / "mesh.glb", n=2000)
    assert len(found.faces) == 3
    assert np.allclose(
        model_surface.triangle_areas(found.vertices, found.faces).sum(),
        model_surface.triangle_areas(vertices, model.faces).sum(),
    )
    assert 1900 < len(found.colored.points) <= 2000
    basis = np.stack([along, up, np.cross(along, up)], axis=1)
    u, v, off = np.linalg.solve(basis, (found.colored.points - corner).T)
    assert np.allclose(off, 0.0, atol=1e-6)
    # pages may be compressed
    assert np.abs(found.colored.color[:, 0] - 255 * u).mean() < 4.0
    assert np.abs(found.colored.color[:, 1] - 255 * v).mean() < 4.0
