"""Rendered images of textured meshes, pixel by pixel."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stillmap.results.report.renderer import (
    BACKGROUND,
    camera_matrix,
    fit_camera,
    look_at,
    main_corners,
    render,
    visible_share,
)

sys.path.insert(0, str(Path(__file__).resolve().parent))

from made_up_room import quad, room, together, wall_page

SIZE = (96, 64)


def facing(page, distance=2.0, width=3.0, height=2.0):
    """A quad across the line of sight of a camera at the origin that looks along y."""
    x, z, y = 0.5 * width, 0.5 * height, distance
    return quad([(-x, y, -z), (x, y, -z), (x, y, z), (-x, y, z)], page)


def ahead():
    return look_at(np.zeros(3), np.array([0.0, 1.0, 0.0]))


def exactly(distance, width=3.0):
    """A picture whose edges are those of the quad."""
    return camera_matrix(SIZE, 2 * np.arctan(0.5 * width / distance))


def test_texture_facing_the_camera_is_reproduced():
    page = np.random.default_rng(0).integers(0, 255, (64, 96, 3)).astype(np.uint8)
    textured = together([facing(0)], [page])
    seen = render(textured, ahead(), exactly(2.0), SIZE)
    assert seen.shape == (64, 96, 3)
    # four samples a quarter of a texel beside its middle: each takes a quarter of its neighbours
    padded = np.pad(page.astype(float), ((1, 1), (1, 1), (0, 0)), mode="edge")
    rows = 0.125 * padded[:-2] + 0.75 * padded[1:-1] + 0.125 * padded[2:]
    wanted = 0.125 * rows[:, :-2] + 0.75 * rows[:, 1:-1] + 0.125 * rows[:, 2:]
    assert np.abs(seen - wanted)[1:-1, 1:-1].max() <= 1.0


def test_texture_is_perspective_correct():
    """Of a floor with a colour for each metre: as rays meet it, one by one."""
    page = np.zeros((4, 1000, 3), np.uint8)
    page[:, :, 0] = np.linspace(0, 250, 1000)
    floor = quad([(0, 20, -1.5), (0, -20, -1.5), (40, -20, -1.5), (40, 20, -1.5)], 0)
    corners, at, number = floor
    along = np.stack([corners[:, 0] / 40.0, at[:, 1]], axis=1)
    textured = together([(corners, along, number)], [page])
    T, K = look_at(np.zeros(3), np.array([1.0, 0.0, -0.5])), camera_matrix(SIZE, 1.0)
    seen = render(textured, T, K, SIZE)[..., 0].astype(float)
    v, u = np.mgrid[:64, :96]
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.shape)], -1)
    rays = rays @ T[:3, :3]
    x = -1.5 / rays[..., 2] * rays[..., 0]
    assert seen == pytest.approx(x / 40.0 * 250.0, abs=1.5)


def test_nearer_faces_hide_farther_ones():
    pages = [np.full((2, 2, 3), 10, np.uint8), np.full((2, 2, 3), 200, np.uint8)]
    textured = together([facing(0, 2.0), facing(1, 4.0, 12.0, 8.0)], pages)
    seen = render(textured, ahead(), camera_matrix(SIZE, 2 * np.arctan(1.5)), SIZE)
    assert (seen[32, 48] == 10).all()
    assert (seen[2, 2] == 200).all()
    assert (seen == 10).all(axis=2).mean() == pytest.approx(0.25, abs=0.01)


def test_untextured_faces_are_grey_before_the_background():
    textured = together([facing(-1)], [])
    K = exactly(1.0)
    seen = render(textured, ahead(), K, SIZE)
    middle = seen[32, 48]
    assert len(set(middle.tolist())) == 1
    assert (seen[0, 0] == BACKGROUND).all()
    assert visible_share(textured, ahead(), K, SIZE, textured_only=True) == 0.0
    painted = replace(textured, page=textured.page + 1, pages=(wall_page((1, 2, 3)),))
    assert visible_share(painted, ahead(), exactly(2.0), SIZE, textured_only=True) == 1.0


def test_without_back_faces_a_room_has_no_ceiling():
    inside = room()
    T = look_at(np.array([0.0, -0.1, 9.0]), np.zeros(3))
    K = camera_matrix(SIZE, 1.0)
    roof = render(inside, T, K, SIZE)
    open_ = render(inside, T, K, SIZE, back_faces=False)
    reds = [(one[..., 0].astype(int) - one[..., 1] > 40).sum() for one in (roof, open_)]
    assert reds[0] == 0
    assert reds[1] > 50


def test_model_without_faces_is_all_background():
    nothing = together([facing(0)], [wall_page((9, 9, 9))])
    empty = replace(nothing, faces=nothing.faces[:0], page=nothing.page[:0])
    assert (render(empty, ahead(), exactly(2.0), SIZE) == BACKGROUND).all()


def test_result_does_not_depend_on_threads():
    T, K = look_at(np.array([1.0, -1.0, 1.4]), np.array([0.0, 3.0, 1.0])), camera_matrix(SIZE, 1.4)
    one, two = (render(room(), T, K, SIZE, threads=n) for n in (1, 3))
    assert np.array_equal(one, two)


def test_visible_share():
    facing_it, K = together([facing(-1)], []), exactly(1.0)
    far = exactly(1.0, 1.5)  # looks as far as the quad's half

    def share(textured, K, **how):
        return visible_share(textured, ahead(), K, SIZE, **how)

    assert share(facing_it, K) == pytest.approx(0.25, abs=0.01)
    assert share(facing_it, far) == pytest.approx(1.0)
    turned = replace(facing_it, faces=np.ascontiguousarray(facing_it.faces[:, ::-1]))
    assert share(turned, K) == share(facing_it, K)
    fronts = [share(one, K, back_faces=False) for one in (facing_it, turned)]
    assert sorted(fronts) == [0.0, share(facing_it, K)]


def test_main_corners_leave_out_islands():
    tiles = [quad([(x, 0, 0), (x + 1, 0, 0), (x + 1, 1, 0), (x, 1, 0)], -1) for x in range(98)]
    far = [quad([(x, 0, 0), (x + 1, 0, 0), (x + 1, 1, 0), (x, 1, 0)], -1) for x in (-900, 900)]
    kept = main_corners(together(tiles + far, []), np.array([0.0, 0.0, 1.0]), 0.011)
    assert (kept[:, 0].min(), kept[:, 0].max()) == (0.0, 98.0)
    away = main_corners(together(tiles, []), np.array([0.0, 0.0, -1.0]), 0.01)
    assert len(away) == 3 * 2 * 98  # nothing is seen from below


@pytest.mark.parametrize("direction", [(1, 0, 0), (-0.5, -0.7, 0.7), (0, 0, 1)])
def test_fitted_camera_shows_all_points(direction):
    points = np.random.default_rng(0).uniform((-9, -2, 0), (4, 3, 5), (50, 3))
    K = camera_matrix(SIZE, 0.8)
    T = fit_camera(points, np.array(direction, float), K, SIZE)
    seen = (points @ T[:3, :3].T + T[:3, 3]) @ K.T
    at = seen[:, :2] / seen[:, 2:]
    assert (seen[:, 2] > 0).all()
    assert (at >= -0.5).all()
    assert (at <= np.array(SIZE) - 0.5).all()
    # it touches two edges that lie across from each other, but for a margin
    reach = (at - (np.array(SIZE) - 1) / 2) / (np.array(SIZE) / 2)
    low, high = reach.min(axis=0), reach.max(axis=0)
    assert -low == pytest.approx(high, abs=0.1)
    assert high.max() == pytest.approx(1 / 1.05, abs=1e-6)


@pytest.mark.parametrize("target", [(3, 1, 0), (0, 0, -5), (0.0, -2.0, 4.0)])
def test_look_at(target):
    eye = np.array([0.5, 0.2, 1.0])
    T = look_at(eye, np.array(target, float))
    assert T[:3, :3] @ T[:3, :3].T == pytest.approx(np.eye(3))
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    seen = T[:3, :3] @ target + T[:3, 3]
    assert seen == pytest.approx([0.0, 0.0, np.linalg.norm(target - eye)])
    up = T[:3, :3] @ [0.0, 0.0, 1.0]
    assert up[1] <= 0.0  # y is down
