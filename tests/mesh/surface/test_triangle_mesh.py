"""Triangles in space."""

import numpy as np
import pytest

from stillmap.mesh.triangle_mesh import Mesh, concatenate_meshes

SQUARE = Mesh(
    np.array([[0.0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]]),
    np.array([[0, 1, 2], [0, 2, 3]], np.int32),
)


def test_a_square_is_two_triangles_that_share_an_edge() -> None:
    np.testing.assert_allclose(SQUARE.areas(), [1.0, 1.0])
    np.testing.assert_allclose(SQUARE.normals(), [[0, 0, 1], [0, 0, 1]])
    assert SQUARE.adjacent_faces().tolist() == [[0, 1]]


def test_a_face_without_area_has_no_normal() -> None:
    flat = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), np.array([[0, 1, 2]], np.int32))
    np.testing.assert_array_equal(flat.normals(), [[0.0, 0, 0]])


def test_a_part_has_the_vertices_that_it_uses() -> None:
    part = SQUARE.select(np.array([False, True]))
    assert part.faces.tolist() == [[0, 1, 2]]
    np.testing.assert_array_equal(part.vertices, SQUARE.vertices[[0, 2, 3]])


def test_joined_meshes_keep_their_faces() -> None:
    both = concatenate_meshes([SQUARE, SQUARE])
    assert both.faces.tolist() == [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]
    assert both.adjacent_faces().tolist() == [[0, 1], [2, 3]]
    assert len(concatenate_meshes([])) == 0


def test_more_than_two_faces_may_share_an_edge() -> None:
    fan = Mesh(
        np.array([[0.0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, 0, 0]]),
        np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]], np.int32),
    )
    assert fan.adjacent_faces().tolist() == [[0, 1], [1, 2]]


def test_a_vertex_that_is_not_there_is_refused() -> None:
    with pytest.raises(ValueError, match="not there"):
        Mesh(np.zeros((2, 3)), np.array([[0, 1, 2]], np.int32))
