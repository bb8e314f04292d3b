"""Changes in plain view need a mover."""

import numpy as np

from stillmap.mapping.witnesses import MoverPoints, is_explained

S = 10**9
PLACES = np.array([[0.0, 0.0], [5.0, 0.0]])


def explained(before, after, xy=(), stamps=()):
    movers = MoverPoints(np.array(xy, float).reshape(-1, 2), np.array(stamps, np.int64))
    times = (np.full(2, int(t * S), np.int64) for t in (before, after))
    return is_explained(PLACES, *times, movers).tolist()


def test_what_was_not_seen_for_long_may_have_moved_by_itself():
    assert explained(10.0, 15.0) == [True, True]
    assert explained(10.0, 10.2) == [False, False]


def test_in_view_a_mover_must_be_near_in_place_and_time():
    assert explained(10.0, 10.2, [(0.5, 0.5)], [11 * S]) == [True, False]
    assert explained(10.0, 10.2, [(0.5, 0.5)], [20 * S]) == [False, False]
    assert explained(10.0, 10.2, [(0.5, 1.5), (5.0, -0.9)], [10 * S, 9 * S]) == [False, True]


def test_thinned_points_keep_one_per_square_and_second():
    rng = np.random.default_rng(0)
    many = MoverPoints(rng.uniform(0.0, 0.25, (500, 2)), rng.integers(0, 3 * S, 500))
    few = many.thin()
    assert len(few.xy) == 3
    assert set((few.stamp_ns // S).tolist()) == {0, 1, 2}
    assert MoverPoints.concatenate([few, MoverPoints.none()]).xy.shape == (3, 2)
