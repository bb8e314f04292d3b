"""Which faces a picture shows."""

import numpy as np
from made_up_rooms import K, box, looking, rectangle

from stillmap import _core
from stillmap.mesh.triangle_mesh import Mesh, concatenate_meshes
from stillmap.mesh.visibility import find_visible_faces, scale_intrinsics

# seen from where y is less
WALL = rectangle([-4.0, 4.0, -3.0], [8.0, 0, 0], [0, 0, 6.0], 24)
AHEAD = looking([0.0, 0, 0], [0.0, 1, 0])


def test_a_wall_by_hand():
    seen = find_visible_faces(WALL, AHEAD)
    uv = (K @ AHEAD.to_camera(WALL.vertices).T).T
    uv = uv[:, :2] / uv[:, 2:]
    expected = ((uv >= 2) & (uv <= [397, 297])).all(axis=1)[WALL.faces].all(axis=1)
    assert 0.3 < expected.mean() < 0.9
    np.testing.assert_array_equal(seen > 0, expected)
    # legs of 8/24 m and 6/24 m, 4 m away
    area = 0.5 * (8 / 24) * (6 / 24) * (300 / 4) ** 2
    np.testing.assert_allclose(seen[expected], area, rtol=1e-5)
    assert not seen[~expected].any()


def test_from_behind_nothing_is_seen():
    turned = Mesh(WALL.vertices, WALL.faces[:, ::-1].copy())
    assert not find_visible_faces(turned, AHEAD).any()
    behind = looking([0.0, 0, 0], [0.0, -1, 0])
    assert not find_visible_faces(WALL, behind).any()


def hidden_share(mesh, view, first):
    """Of the first faces, the share of the area that is hidden, by a large picture."""
    fine = scale_intrinsics(view.camera.K, 4.0)
    size = 4 * view.camera.width, 4 * view.camera.height
    _, with_all = _core.render_z_buffer(
        mesh.vertices, mesh.faces, fine, view.T_camera_map, *size, near=1
    )
    alone = mesh.faces[:first]
    _, of_first = _core.render_z_buffer(
        mesh.vertices, alone, fine, view.T_camera_map, *size, near=1
    )
    counts = [np.bincount(f[(f >= 0) & (f < first)], minlength=first) for f in (with_all, of_first)]
    return 1.0 - counts[0] / np.maximum(counts[1], 1)


def test_what_stands_before_a_wall_hides_it():
    mesh = concatenate_meshes([WALL, box([-0.6, 2.0, -0.5], [0.4, 2.6, 0.7])])
    alone, seen = find_visible_faces(WALL, AHEAD) > 0, find_visible_faces(mesh, AHEAD)
    hidden = hidden_share(mesh, AHEAD, len(WALL))
    of_wall = seen[: len(WALL)] > 0
    assert 40 < np.sum(hidden[alone] > 0.01) < 400
    assert not of_wall[hidden > 0.01].any()
    # little more than what is hidden is given up: what is a pixel of the small picture beside it
    assert np.mean(of_wall[alone & (hidden == 0.0)]) > 0.93
    # the side of the box that faces the camera
    assert (seen[len(WALL) :] > 0).sum() == 2


def test_a_noisy_surface_does_not_hide_itself():
    rng = np.random.default_rng(0)
    floor = rectangle([-4.0, 0.5, -1.2], [8.0, 0, 0], [0, 8.0, 0], 80)
    noisy = Mesh(floor.vertices + rng.normal(0.0, 0.005, floor.vertices.shape), floor.faces)
    view = looking([0.0, 0, 0], [0.0, 3, -1.0])
    flat, seen = find_visible_faces(floor, view) > 0, find_visible_faces(noisy, view)
    assert flat.sum() > 3000
    towards = -noisy.centers / np.linalg.norm(noisy.centers, axis=1, keepdims=True)
    front = flat & ((noisy.normals() * towards).sum(axis=1) > 0.2)
    assert (seen[front] > 0).mean() > 0.95
