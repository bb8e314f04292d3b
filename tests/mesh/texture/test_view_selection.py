"""Which picture paints which face."""

import itertools

import numpy as np
import pytest

from stillmap.mesh.texture.view_selection import Candidates, select_views, view_utility


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
    sharpest = view_utility(p, np.array([100.0, 100.0, 1e6]), np.ones(3), use_occlusion=False)
    assert np.argmax(sharpest) == 2


def test_twice_the_resolution_is_worth_its_logarithm() -> None:
    u = view_utility(np.ones(2), np.array([100.0, 400.0]), np.ones(2))
    assert u[1] - u[0] == pytest.approx(np.log(2.0))


def _energy(c: Candidates, pairs: np.ndarray, border: float, label: np.ndarray) -> float:
    lost = c.utility.max(axis=1) - c.utility[np.arange(len(label)), label]
    picture = c.view[np.arange(len(label)), label]
    return float(lost.sum() + border * (picture[pairs[:, 0]] != picture[pairs[:, 1]]).sum())


@pytest.mark.parametrize("seed", range(8))
def test_on_a_strip_no_other_choice_costs_less(seed: int) -> None:
    rng = np.random.default_rng(seed)
    F, K, border = 6, 3, 0.7
    c = Candidates.empty(F, K)
    for k in range(4):
        faces = np.flatnonzero(rng.random(F) < 0.7)
        c.add(k, faces, rng.normal(size=len(faces)), np.ones(len(faces)))
    c.add(9, np.arange(F), np.full(F, -3.0), np.ones(F))  # each has one at least
    pairs = np.stack([np.arange(F - 1), np.arange(1, F)], axis=1).astype(np.int32)
    got = select_views(c, pairs, border)
    label = np.argmax(c.view == got[:, None], axis=1)
    counts = (c.view != -1).sum(axis=1)
    least = min(
        _energy(c, pairs, border, np.array(labels))
        for labels in itertools.product(*(range(n) for n in counts))
    )
    assert _energy(c, pairs, border, label) == pytest.approx(least, abs=1e-4)


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
