"""How much of a texture shows people who were pasted into its pictures."""

import numpy as np
import pytest
from pasted_scores import scores

from stillmap.core.camera import Camera, Images
from stillmap.eval.mesh import TextureRecord
from stillmap.io.rgbd import T_BASE_CAMERA

K = np.array([[100.0, 0.0, 49.5], [0.0, 100.0, 49.5], [0.0, 0.0, 1.0]])
CAMERA = Camera("color", 100, 100, K, "", np.zeros(0), T_BASE_CAMERA)
IMAGES = Images(np.arange(2), np.zeros(2, np.int32), (CAMERA,), lambda _: np.zeros((100, 100, 3)))
# 4 m ahead of the camera, which looks along x: two walls of 1 m by 1 m side by side, and one behind
LEFT = np.array([[4, 1, 0], [4, 0, 0], [4, 0, 1], [4, 1, 1]], float)
WALLS = np.concatenate([LEFT, LEFT - [0, 1, 0], LEFT - [8, 0, 0]])
FACES = np.concatenate([np.array([[0, 1, 2], [0, 2, 3]], np.int32) + 4 * k for k in range(3)])


def record(image):
    places = np.tile(np.linalg.inv(T_BASE_CAMERA), (2, 1, 1))
    return TextureRecord(WALLS, FACES, np.repeat(np.array(image, np.int32), 2), places)


def test_the_share_that_shows_people():
    people = np.zeros((2, 100, 100), bool)
    people[0, :, 50:] = True
    found = scores(record([0, 0, -1]), IMAGES, people)
    assert found.area == pytest.approx(3.0)
    assert found.painted == pytest.approx(2 / 3, abs=1e-3)
    assert found.person == pytest.approx(0.5, abs=1e-2)
    # the other picture shows the right wall without anybody, none the one behind
    assert found.free == pytest.approx(2 / 3, abs=1e-3)
    assert found.covered == 1.0


def test_what_nobody_hides_may_have_no_picture():
    people = np.zeros((2, 100, 100), bool)
    people[:, :, 50:] = True
    found = scores(record([-1, 1, -1]), IMAGES, people)
    assert found.person == 1.0
    assert found.free == pytest.approx(1 / 3, abs=1e-2)
    assert found.covered < 0.02
    unpainted = scores(record([-1, -1, -1]), IMAGES, people)
    assert unpainted.painted == 0.0
    assert np.isnan(unpainted.person)
