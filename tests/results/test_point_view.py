"""The view of points in 3D in the report."""

import base64
import dataclasses
import io
import math

import numpy as np
import pytest
from PIL import Image
from recordings import of_one_sensor

from stillmap.results.colors import ORANGE
from stillmap.results.report.page import render_report
from stillmap.results.report.point_view import draw_points_3d, find_ceiling, points_data

WHITE, RED = (255, 255, 255), (255, 0, 0)


def ahead(points, colors):
    """Drawn by a camera at the origin that looks along y."""
    T = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])
    picture = draw_points_3d(np.array(points, np.float32), np.array(colors, np.uint8), T)
    return np.asarray(picture)


def test_near_points_hide_far_ones():
    for order in (1, -1):
        points, colors = [(0, 5, 0), (0, 9, 0)][::order], [WHITE, RED][::order]
        pixels = ahead(points, colors)
        assert (pixels == WHITE).all(axis=2).any()
        assert not (pixels == RED).all(axis=2).any()


def test_points_behind_the_camera_are_not_drawn():
    pixels = ahead([(0, -5, 0), (100, 1, 0)], [WHITE, RED])
    assert (pixels == pixels[0, 0]).all()


def test_far_points_are_smaller():
    near, far = ((ahead([(0, y, 0)], [WHITE]) == 255).all(axis=2).sum() for y in (5.0, 500.0))
    assert (near, far) == (4, 1)


def test_ceiling():
    rng = np.random.default_rng(0)
    walls = rng.uniform(0.0, 6.0, 5000).astype(np.float32)
    flat = rng.normal(6.0, 0.02, 2000).astype(np.float32)
    assert find_ceiling(walls, 0.0) == math.inf
    assert find_ceiling(np.concatenate([walls, flat]), 0.0) == pytest.approx(5.7, abs=0.1)
    # the floor is none
    assert find_ceiling(np.concatenate([walls, flat - 6.0]), 0.0) == math.inf
    assert find_ceiling(np.zeros(0, np.float32), 0.0) == math.inf


@pytest.fixture
def corridor(result):
    """The result with points in 3D: a floor, two walls, and somebody between them."""
    rng = np.random.default_rng(1)
    n = 4000
    x = rng.uniform(0, 20, n)
    floor = np.stack([x, rng.uniform(-2, 2, n), 0 * x], axis=1)
    walls = np.stack([x, rng.choice([-2, 2], n), rng.uniform(0, 3, n)], axis=1)
    person = np.stack(
        [rng.uniform(9, 9.5, n), rng.uniform(-0.3, 0.3, n), rng.uniform(0, 1.7, n)], 1
    )
    points = np.concatenate([floor, walls, person]).astype(np.float32)
    recording = of_one_sensor(
        np.zeros(1, np.int64),
        np.array([0, len(points)], np.int64),
        points,
        np.ones(len(points), bool),
    )
    p_static = np.repeat(np.array([0.9, 0.9, 0.1], np.float32), n)
    return dataclasses.replace(
        result, recording=recording, poses=np.eye(4)[None], p_static=p_static, objects=[]
    )


def test_dynamic_points_are_in_the_second_picture_only(corridor):
    data = points_data(corridor)
    shown = []
    for uri in data["images"]:
        image = Image.open(io.BytesIO(base64.b64decode(uri.partition(",")[2]))).convert("RGB")
        assert image.size == data["size"]
        apart = np.abs(np.asarray(image).astype(int) - ORANGE).sum(axis=2)
        shown.append(int((apart < 60).sum()))
    assert shown[0] < 20
    assert shown[1] > 500
    assert data["heights"] == (0.0, 2.9)
    assert not data["has_ceiling"]


def test_section_is_in_reports_of_3d_results_alone(corridor, result, section):
    text = section(render_report(corridor), "In 3D")
    assert "colored by height from 0.0 m to 2.9 m" in text
    assert text.count("<img") == 2
    assert 'id="show-moving" autocomplete' in text  # off at first
    assert section(render_report(result), "In 3D") == ""
