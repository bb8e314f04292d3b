"""What lies outside of all boxes is static rather, as far as movers are followed."""

import numpy as np
import pytest

from stillmap.core.recording import Recording
from stillmap.tracking.explained_hits import MoverHits
from stillmap.tracking.unfollowed_hits import weigh_unfollowed_hits


def recorded(n, hit=True):
    return Recording(
        stamp_ns=np.zeros(1, np.int64),
        offset=np.array([0, n], np.int64),
        points=np.zeros((n, 2), np.float32),
        hit=np.full(n, hit),
        T_odom_base=None,
        T_base_sensor=np.eye(3)[None],
        sensor=np.zeros(1, np.int32),
    )


def weighed(certain, likely, undecided, hit=True):
    """P(static) of the undecided hits within boxes, and outside.

    Each argument: how many hits there are, and how many of them are within boxes.
    """
    groups = [(certain, 0.01), (likely, 0.3), (undecided, 0.9)]
    p = np.concatenate([np.full(n, p, np.float32) for (n, _), p in groups])
    within = np.concatenate([np.arange(n) < k for (n, k), _ in groups])
    explained = np.where(within, np.float32(0.01), p)
    beam = np.flatnonzero(within)
    before = explained.copy()
    on_movers = MoverHits(beam, np.zeros(len(beam), np.intp), np.ones(len(beam)))
    after = weigh_unfollowed_hits(recorded(len(p), hit), p, explained, on_movers)
    np.testing.assert_array_equal(explained, before)
    np.testing.assert_array_equal(after[within], explained[within])
    np.testing.assert_array_equal(after[p < 0.5], explained[p < 0.5])
    outside = after[(p >= 0.5) & ~within]
    assert (outside == outside[0]).all()
    return float(outside[0])


def test_where_all_movers_are_followed_the_rest_is_static():
    assert weighed((1000, 1000), (500, 500), (1000, 100)) > 0.99


def test_where_nobody_is_followed_labels_stay():
    assert weighed((1000, 0), (500, 0), (1000, 0)) == pytest.approx(0.9, abs=1e-3)


def test_the_likely_hits_show_what_the_certain_ones_do_not():
    """People who stop are certain and followed until then; those behind others are not."""
    followed = weighed((1000, 900), (500, 450), (1000, 50))
    assert weighed((1000, 900), (500, 50), (1000, 50)) < followed - 0.02


def test_fewer_hits_on_movers_than_the_cells_expect_are_half_believed():
    # 100 of 1000 undecided hits should be on movers
    as_expected = weighed((1000, 1000), (500, 500), (1000, 100))
    assert 0.94 < weighed((1000, 1000), (500, 500), (1000, 0)) < as_expected - 0.01


def test_by_bayes_rule():
    """A third of the likely and of the undecided hits on movers are followed."""
    p = weighed((0, 0), (10**6, 333_333), (10**6, 33_670))
    assert p == pytest.approx(0.9 / (0.9 + 0.1 * 2 / 3), abs=1e-3)


def test_beams_without_a_return_keep_the_prior():
    assert weighed((100, 0), (50, 0), (100, 0), hit=False) == np.float32(0.9)
