"""Detection of the maximum-range code, of the meaning of zero, and of free ranges."""

import numpy as np
import pytest

from stillmap.prepare.max_range import apply_range_rule, find_max_range, infer_range_rule
from stillmap.prepare.options import ReadOptions

T, N = 200, 181


def room(rng, noise, moving, quantum, half_width=3.0):
    """Ranges (T, N) in a 9.8 m x 6 m room, cm-quantised where `quantum` is given."""
    angle = np.radians(np.linspace(-90, 90, N))
    x = 1.0 + (np.linspace(0, 3, T) if moving else np.zeros(T))
    with np.errstate(divide="ignore"):
        ahead = (9.8 - x)[:, None] / np.maximum(np.cos(angle), 1e-9)
        side = half_width / np.maximum(np.abs(np.sin(angle)), 1e-9)
    ranges = np.minimum(ahead, side) + rng.normal(0.0, noise, (T, N))
    return (np.round(ranges / quantum) * quantum if quantum else ranges).astype(np.float32)


@pytest.mark.parametrize("noise", [0.01, 0.02, 0.03])
@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("quantum", [0.0, 0.001, 0.01])
@pytest.mark.parametrize("half_width", [3.0, 0.5])  # of a corridor the end fills a few beams
def test_noisy_walls_are_no_code(noise, moving, quantum, half_width):
    ranges = room(np.random.default_rng(5), noise, moving, quantum, half_width)
    assert find_max_range(ranges).threshold is None


@pytest.mark.parametrize("clip", [3.5, 5.0, 8.0])
@pytest.mark.parametrize("noise", [0.005, 0.02])
def test_clipped_sensor(clip, noise):
    ranges = np.minimum(room(np.random.default_rng(8), noise, True, 0.0), np.float32(clip))
    found = find_max_range(ranges)
    assert found.coded
    assert found.threshold == pytest.approx(clip)
    _, hit = apply_range_rule(ranges, infer_range_rule(ranges, None, ReadOptions())[0])
    np.testing.assert_array_equal(hit, ranges < np.float32(clip))


def test_smeared_code_above_real_readings():
    rng = np.random.default_rng(9)
    ranges = np.round(rng.uniform(1.0, 20.0, (T, N)), 2)
    codes = rng.random((T, N)) < 0.05
    smear = rng.choice([51.10, 51.14, 51.15, 51.16], (T, N), p=[0.03, 0.06, 0.89, 0.02])
    ranges = np.where(codes, smear, ranges)
    ranges[17, 30] = 50.75
    assert find_max_range(ranges.astype(np.float32)).threshold == 51.10


def test_rare_sick_overflow_is_known_by_its_value():
    ranges = np.full((T, N), 5.0, np.float32)
    ranges[3, 4] = 81.91
    assert find_max_range(ranges).threshold == 81.91


def test_declared_maximum():
    ranges = np.linspace(1.0, 9.0, 100, dtype=np.float32)
    found = find_max_range(ranges, 8.0)
    assert (found.threshold, found.coded) == (8.0, False)
    for useless in (0.0, -1.0, float("nan"), float("inf")):
        assert find_max_range(ranges, useless).threshold is None


@pytest.mark.parametrize("value", [np.inf, 3.4e38, 1e4])
def test_infinite_readings_are_maximum_range(value):
    ranges = np.random.default_rng(2).uniform(1.0, 5.0, (T, N)).astype(np.float32)
    ranges[:, ::7] = value
    rule, _ = infer_range_rule(ranges, None, ReadOptions())
    assert rule.threshold is None
    length, hit = apply_range_rule(ranges, rule)
    assert not hit[:, ::7].any()
    assert hit.sum() == T * N - ranges[:, ::7].size
    assert np.all(length[:, ::7] == np.float32(rule.free_range))
    assert 4.99 < rule.free_range < 5.0


def zeros_and_hits(share, code=None):
    rng = np.random.default_rng(3)
    ranges = rng.uniform(1.0, 5.0, (T, N)).astype(np.float32)
    ranges[rng.random((T, N)) < share] = 0.0
    if code:
        ranges[rng.random((T, N)) < 0.02] = code
    return ranges


@pytest.mark.parametrize(
    ("share", "code", "wanted", "means"),
    [
        (0.05, None, "auto", "max-range"),
        (0.001, None, "auto", "unusable"),
        (0.05, 81.83, "auto", "unusable"),
        (0.05, np.inf, "auto", "unusable"),
        (0.15, np.inf, "auto", "unusable"),  # seven times as many
        (0.4, np.inf, "auto", "max-range"),
        (0.4, 81.83, "auto", "max-range"),
        (0.05, None, "unusable", "unusable"),
        (0.05, 81.83, "max-range", "max-range"),
    ],
)
def test_what_zero_means(share, code, wanted, means):
    ranges = zeros_and_hits(share, code)
    rule, _ = infer_range_rule(ranges, None, ReadOptions(zero_means=wanted))
    assert rule.zero_means == means
    length, hit = apply_range_rule(ranges, rule)
    zero = ranges == 0.0
    assert not hit[zero].any()
    assert np.isnan(length[zero]).all() == (means == "unusable")


def test_unusable_readings():
    ranges = np.array([[np.nan, -np.inf, -1.0, 0.01, 0.5, 1.0]], np.float32)
    rule, _ = infer_range_rule(ranges, None, ReadOptions(min_range=0.6, zero_means="unusable"))
    length, hit = apply_range_rule(ranges, rule)
    assert hit.tolist() == [[False] * 5 + [True]]
    assert np.isnan(length[0, :5]).all()


def test_free_range_is_what_the_laser_really_sees():
    ranges = zeros_and_hits(0.0, 81.83)
    ranges[0, 0] = 60.0  # one far reading does not make the laser see 60 m
    clipped = np.minimum(ranges, np.float32(3.0))
    for readings, given, free in ((ranges, None, 4.95), (ranges, 7.0, 7.0), (clipped, None, 3.0)):
        rule, _ = infer_range_rule(readings, None, ReadOptions(free_range=given))
        assert rule.free_range == pytest.approx(free, abs=0.06 if given is None else 0)


def test_given_maximum_range():
    ranges = zeros_and_hits(0.0, 81.83)
    rule, warnings = infer_range_rule(ranges, None, ReadOptions(max_range=4.0))
    assert not warnings
    assert (rule.threshold, rule.threshold_how) == (4.0, "given")
    assert rule.free_range < 4.0
    _, (warning, *_) = infer_range_rule(ranges, None, ReadOptions(max_range=90.0))
    assert "81.83" in warning
