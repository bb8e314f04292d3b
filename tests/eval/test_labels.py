import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stillmap.results.eval.labels import (
    assign_equal_mass_bins,
    assign_equal_width_bins,
    compute_average_precision,
    compute_calibration_error,
    score_labels,
)


def scores(p_dynamic, dynamic, hit=None):
    p = np.array(p_dynamic, np.float64)
    known = np.ones(len(p), bool) if hit is None else np.array(hit, bool)
    return score_labels(1 - p, ~np.array(dynamic, bool), known)


def precision_area(score, positive) -> float:
    """The definition, threshold by threshold."""
    area, recall_before = 0.0, 0.0
    for threshold in sorted(set(score), reverse=True):
        called = [s >= threshold for s in score]
        both = sum(c and y for c, y in zip(called, positive, strict=True))
        recall = both / sum(positive)
        area += (recall - recall_before) * both / sum(called)
        recall_before = recall
    return area


@given(st.lists(st.tuples(st.integers(0, 6), st.booleans()), min_size=1, max_size=30))
def test_average_precision_follows_its_definition(pairs):
    score = np.array([s for s, _ in pairs], float)
    positive = np.array([y for _, y in pairs])
    got = compute_average_precision(score, positive)
    if positive.any():
        assert got == pytest.approx(precision_area(score.tolist(), positive.tolist()))
    else:
        assert math.isnan(got)


def test_labels_that_differ_only_near_one_are_still_ranked():
    p_static = np.array([1e-30, 1e-20, 1e-10], np.float32)
    s = score_labels(p_static, np.array([False, True, True]), np.ones(3, bool))
    assert s.average_precision == 1.0


def test_all_scores_by_hand():
    s = scores([0.9, 0.8, 0.6, 0.2, 0.1], [1, 1, 0, 1, 0])
    assert (s.hits, s.dynamic, s.unlabelled) == (5, 3, 0)
    assert (s.precision, s.recall, s.f1) == pytest.approx((2 / 3, 2 / 3, 2 / 3))
    assert s.average_precision == pytest.approx((1 + 1 + 3 / 4) / 3)
    assert s.brier == pytest.approx((0.01 + 0.04 + 0.36 + 0.64 + 0.01) / 5)
    wanted = -sum(math.log(q) for q in (0.9, 0.8, 0.4, 0.2, 0.9)) / 5
    assert s.log_loss == pytest.approx(wanted)
    assert s.ece == pytest.approx((0.1 + 0.2 + 0.6 + 0.8 + 0.1) / 5)  # a bin for each
    assert s.share_called_dynamic == pytest.approx(3 / 5)
    assert s.unsure == 5
    assert s.ece_unsure == pytest.approx(s.ece)


def test_only_labelled_beams_that_hit_count():
    s = scores([0.9, math.nan, math.nan, 0.9, 0.1], [1, 1, 0, 0, 0], hit=[1, 1, 0, 0, 1])
    assert (s.hits, s.dynamic, s.unlabelled) == (2, 1, 1)
    assert (s.f1, s.average_precision) == (1.0, 1.0)


def test_nothing_dynamic_leaves_ranking_undefined():
    s = scores([0.0, 0.1], [0, 0])
    plain = s.to_dict()
    for name in ("average_precision", "precision", "recall", "f1"):
        assert plain[name] is None
    assert s.brier == pytest.approx(0.005)
    assert plain["unsure"] == 1
    empty = score_labels(np.zeros(0, np.float32), np.zeros(0, bool), np.zeros(0, bool))
    assert empty.to_dict()["log_loss"] is None
    assert scores([0.0], [1]).log_loss == pytest.approx(-math.log(1e-6))  # as documented
    assert scores([0.5, 0.5], [1, 0]).share_called_dynamic == 0.0
    json.dumps(empty.to_dict(), allow_nan=False)


def test_calibration_error_of_one_bin():
    p, positive = np.array([0.70, 0.72, 0.71, 0.71]), np.array([1, 0, 0, 1], bool)
    assert compute_calibration_error(p, positive, assign_equal_width_bins(p)) == pytest.approx(0.21)
    edges = np.array([0.0, 0.066, 0.067, 0.999, 1.0])
    assert assign_equal_width_bins(edges).tolist() == [0, 0, 1, 14, 14]


def test_equal_mass_bins_are_filled_alike_and_keep_ties_together():
    rng = np.random.default_rng(0)
    p = rng.beta(0.3, 2, 3000)
    assert np.bincount(assign_equal_mass_bins(p)).tolist() == [200] * 15
    tied = np.repeat([0.1, 0.2, 0.9], [1000, 10, 5])
    assert len(set(assign_equal_mass_bins(tied)[:1000].tolist())) == 1
    order = rng.permutation(len(tied))
    np.testing.assert_array_equal(
        assign_equal_mass_bins(tied)[order], assign_equal_mass_bins(tied[order])
    )


def test_calibrated_labels_have_a_small_error_and_shifted_ones_have_not():
    rng = np.random.default_rng(1)
    p = rng.uniform(0, 1, 100_000)
    y = rng.uniform(0, 1, len(p)) < p
    assert scores(p, y).ece_unsure < 0.01
    assert scores(p, y).ece < 0.01
    assert scores(p**2, y).ece_unsure > 0.1


def test_what_is_no_probability_or_fits_nothing_is_refused():
    with pytest.raises(ValueError, match="0, 1"):
        scores([1.5], [1])
    with pytest.raises(ValueError, match="lengths differ"):
        score_labels(np.zeros(3), np.zeros(2, bool), np.zeros(3, bool))


def test_average_precision_by_hand():
    # scikit-learn's documented example has 0.8333...
    score, positive = np.array([0.1, 0.4, 0.35, 0.8]), np.array([0, 0, 1, 1], bool)
    assert compute_average_precision(score, positive) == pytest.approx(1 / 2 + 1 / 2 * 2 / 3)
