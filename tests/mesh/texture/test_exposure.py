"""Pictures of one exposure."""

import numpy as np

from stillmap.mesh.view_selection import estimate_gains

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


def test_what_differs_for_other_reasons_stays_as_it_is():
    rng = np.random.default_rng(2)
    picture, colours = seen(np.ones((4, 3)))
    assert (estimate_gains(picture, colours, 4) == 1.0).all()
    # a shadow that moves lies on a third of what each sees
    dark = rng.random(picture.shape) < 0.33
    colours[dark] *= 0.4
    assert (estimate_gains(picture, colours, 4) == 1.0).all()


def test_nothing_is_cut_off_or_brightened_beyond_measure():
    picture, colours = seen(np.array([[1.0], [6.0], [0.15], [1.0]]) * np.ones(3), people=0.0)
    colours = np.clip(colours, 0.0, 255.0)
    found = estimate_gains(picture, colours, 4)
    assert found.min() >= 0.5
    assert found.max() <= 2.0
