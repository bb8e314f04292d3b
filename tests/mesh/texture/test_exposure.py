"""Pictures of one exposure."""

import numpy as np
import pytest

from stillmap.core.camera import Camera, Images
from stillmap.mesh.texture.view_selection import apply_gains, estimate_gains
from stillmap.mesh.texture.views import View

CAMERA = Camera("front", 4, 3, np.eye(3), "", np.zeros(0), np.eye(4))
FACTORS = np.array([[1.0, 1.0, 1.0], [1.3, 1.2, 1.1], [0.7, 0.8, 0.9], [1.0, 0.9, 1.2]])


def seen(factors, faces=2000, noise=2.0, people=0.1, seed=1):
    """Faces of random colours, each in three pictures one after the other; in some stands
    somebody."""
    rng, n = np.random.default_rng(seed), len(factors)
    first = rng.integers(0, n, faces)
    picture = ((first[:, None] + np.arange(3)) % n).astype(np.int32)
    colours = rng.uniform(40.0, 150.0, (faces, 1, 3)) * factors[picture]
    hidden = rng.random(picture.shape) < people
    colours[hidden] = rng.uniform(20.0, 230.0, (int(hidden.sum()), 3))
    return picture, (colours + rng.normal(0.0, noise, colours.shape)).astype(np.float32)


def test_pictures_are_brightened_until_they_agree():
    found = estimate_gains(*seen(FACTORS), len(FACTORS))
    level = found * FACTORS
    assert np.abs(level / level.mean(axis=0) - 1.0).max() < 0.02
    assert np.abs(np.log(found).mean(axis=0)).max() < 1e-6  # as bright as before on the whole


def test_they_are_those_of_least_squares():
    picture, colours = seen(FACTORS, people=0.0)
    rows, right, weight = [], [], []
    logs = np.log(colours)
    for i in range(4):
        for j in range(i + 1, 4):
            d = []
            for a, b in ((0, 1), (0, 2), (1, 2)):
                at = (picture[:, a] == i) & (picture[:, b] == j)
                d.append(logs[at, b] - logs[at, a])
                at = (picture[:, a] == j) & (picture[:, b] == i)
                d.append(logs[at, a] - logs[at, b])
            each = np.concatenate(d)
            middle = np.sort(each, axis=0)[(len(each) - 1) // 2]
            spread = np.sort(np.abs(each - middle).max(axis=1))[(len(each) - 1) // 2]
            weight.append(len(each) / (len(each) + 100.0) / (1.0 + (spread / 0.05) ** 2))
            rows.append(np.eye(4)[i] - np.eye(4)[j])
            right.append(middle)
    w = np.sqrt(weight)[:, None]
    A = np.concatenate([w * np.array(rows), 0.1 * np.eye(4)])
    b = np.concatenate([w * np.array(right), np.zeros((4, 3))])
    expected = np.exp(np.linalg.lstsq(A, b)[0])
    np.testing.assert_allclose(estimate_gains(picture, colours, 4), expected, rtol=1e-5)


def test_what_differs_for_other_reasons_stays_as_it_is():
    rng = np.random.default_rng(2)
    picture, colours = seen(np.ones((4, 3)))
    assert (estimate_gains(picture, colours, 4) == 1.0).all()
    # a shadow that moves lies on a third of what each sees
    dark = rng.random(picture.shape) < 0.33
    colours[dark] *= 0.4
    assert (estimate_gains(picture, colours, 4) == 1.0).all()


def test_of_pictures_with_nothing_in_common_nothing_is_known():
    picture, colours = seen(FACTORS)
    colours[picture == 2] = np.nan  # damaged
    found = estimate_gains(picture, colours, 5)  # the last one shows nothing
    assert (found[[2, 4]] == 1.0).all()
    assert np.ptp((found * np.append(FACTORS, np.ones((1, 3)), axis=0))[[0, 1, 3]]) < 0.2
    assert (estimate_gains(picture[:20], colours[:20], 5) == 1.0).all()
    assert estimate_gains(np.zeros((0, 1), np.int32), np.zeros((0, 1, 3), np.float32), 0).shape == (
        0,
        3,
    )
    assert (estimate_gains(picture[:, :1], colours[:, :1], 5) == 1.0).all()


def test_nothing_is_cut_off_or_brightened_beyond_measure():
    picture, colours = seen(np.array([[1.0], [6.0], [0.15], [1.0]]) * np.ones(3), people=0.0)
    colours = np.clip(colours, 0.0, 255.0)
    found = estimate_gains(picture, colours, 4)
    assert found.min() >= 0.5
    assert found.max() <= 2.0


@pytest.mark.parametrize("channels", [None, 3, 4])
def test_pictures_are_read_so(channels):
    shape = (3, 4) if channels is None else (3, 4, channels)
    picture = np.random.default_rng(3).integers(0, 256, shape).astype(np.uint8)
    deep = np.arange(12, dtype=np.uint16).reshape(3, 4)
    images = Images(
        np.arange(3), np.zeros(3, np.int32), (CAMERA,), lambda k: deep if k == 2 else picture.copy()
    )
    views = [View(k, k, CAMERA, np.eye(4)) for k in (1, 2)]
    found = apply_gains(images, views, np.array([[1.5, 1.0, 0.5], [2.0, 2.0, 2.0]]))
    np.testing.assert_array_equal(found.read(0), picture)
    np.testing.assert_array_equal(found.read(2), deep)
    factors = np.array([1.5, 1.0, 0.5, 1.0])[: channels or 1]
    wide = picture[..., None] if channels is None else picture
    expected = np.rint(wide * factors).clip(0, 255).astype(np.uint8).reshape(shape)
    np.testing.assert_array_equal(found.read(1), expected)
    assert found.read(1).dtype == np.uint8
