"""Which picture paints which face."""

import numpy as np

from stillmap.mesh.view_selection import Candidates, select_views, view_utility


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
