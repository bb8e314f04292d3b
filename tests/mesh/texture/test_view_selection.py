"""Which picture paints which face, and how bright it is."""

import numpy as np
from made_up_rooms import looking, rectangle

from stillmap.mesh.view_selection import (
    Candidates,
    estimate_gains,
    reject_inconsistent_views,
    sample_face_colors,
    select_views,
    view_utility,
)


def test_the_best_pictures_of_each_face_are_kept() -> None:
    rng = np.random.default_rng(1)
    F, K, pictures = 50, 3, 11
    utilities = rng.normal(size=(pictures, F))
    sees = rng.random((pictures, F)) < 0.5
    kept = Candidates.empty(F, K)
    for k in range(pictures):
        faces = np.flatnonzero(sees[k])
        kept.add(k, faces, utilities[k, faces], np.full(len(faces), 0.01 * k))
    for f in range(F):
        mine = [k for k in np.argsort(-utilities[:, f]) if sees[k, f]][:K]
        expected = mine + [-1] * (K - len(mine))
        assert kept.view[f].tolist() == expected
        np.testing.assert_allclose(kept.p_static[f, : len(mine)], 0.01 * np.array(mine), rtol=1e-6)


def test_what_probably_shows_a_mover_is_not_used_however_sharp() -> None:
    p = np.array([0.99, 0.95, 0.1])
    u = view_utility(p, np.array([100.0, 100.0, 1e6]), np.ones(3))
    assert u[0] > u[1]
    assert u[2] == -np.inf


def test_neighbours_take_the_same_picture_where_little_is_lost() -> None:
    c = Candidates.empty(4, 2)
    every = np.arange(4)
    c.add(0, every, np.array([1.0, 1.0, 0.9, 1.0]), np.ones(4))
    c.add(1, every, np.array([0.0, 0.0, 1.0, 0.0]), np.ones(4))
    pairs = np.array([[0, 1], [1, 2], [2, 3]], np.int32)
    assert select_views(c, pairs, 0.5).tolist() == [0, 0, 0, 0]
    assert select_views(c, pairs, 0.0).tolist() == [0, 0, 1, 0]


def test_a_face_without_a_picture_has_none_and_parts_its_neighbours() -> None:
    c = Candidates.empty(3, 2)
    c.add(5, np.array([0]), np.array([1.0]), np.ones(1))
    c.add(6, np.array([2]), np.array([1.0]), np.ones(1))
    pairs = np.array([[0, 1], [1, 2]], np.int32)
    assert select_views(c, pairs, 10.0).tolist() == [5, -1, 6]


WALL = rectangle([-0.5, 4.0, -0.5], [1.0, 0, 0], [0, 0, 1.0], 2)


def left(shades, odd=40.0):
    views = [looking([0.0, 0, 0], [0.0, 1, 0], number) for number in range(len(shades))]
    candidates, n = Candidates.empty(len(WALL), 6), len(WALL)
    for number in range(len(shades)):
        p = np.full(n, 0.9)
        candidates.add(number, np.arange(n), np.full(n, -float(number)), p)

    def colours(view):
        shade = shades[view.image]
        return None if shade is None else np.full((300, 400, 3), shade, np.uint8)

    found = reject_inconsistent_views(
        candidates, sample_face_colors(WALL, candidates, views, colours), odd
    )
    assert (found.view == found.view[0]).all()
    assert (np.isfinite(found.utility) == (found.view >= 0)).all()
    return [k for k in found.view[0].tolist() if k >= 0]


def test_one_that_most_contradict_is_left_out_where_most_agree():
    assert left([200, 100, 104, 98]) == [1, 2, 3]
    assert left([100, 110, 104, 98]) == [0, 1, 2, 3]
    assert left([200, 100]) == [0, 1]
    assert left([10, 80, 150, 220]) == [0, 1, 2, 3]


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
