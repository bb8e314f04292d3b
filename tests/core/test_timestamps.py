"""Exact stamps, and records in order of time."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stillmap.core.timestamps import (
    MAX_STAMP_NS,
    longest_non_decreasing,
    order_in_time,
    parse_ns,
)


@pytest.mark.parametrize(
    ("text", "ns"),
    [
        ("976052857.337483", 976052857337483000),
        ("976052857.337483123", 976052857337483123),
        ("1.23e+09", 1_230_000_000 * 10**9),
        ("1e-3", 1_000_000),
        ("+5", 5 * 10**9),
        ("-0.5", -500_000_000),
        ("0", 0),
        ("0.0000000005", 0),  # half to even
        ("0.0000000015", 2),
        ("1e-999999", 0),
        (".25", 250_000_000),
    ],
)
def test_exact(text, ns):
    assert parse_ns(text) == ns


@pytest.mark.parametrize(
    "text", ["", "x", "nan", "inf", "-inf", "1e10", "4.7e9", "-4.7e9", "1_0", "1e999999999", "snan"]
)
def test_refused(text):
    with pytest.raises(ValueError, match="time stamp"):
        parse_ns(text)


@given(st.integers(-MAX_STAMP_NS, MAX_STAMP_NS))
def test_every_nanosecond_is_kept(ns):
    sign = "-" if ns < 0 else ""
    assert parse_ns(f"{sign}{abs(ns) // 10**9}.{abs(ns) % 10**9:09d}") == ns


@pytest.mark.parametrize(
    ("tenths", "order"),
    [
        ([], []),
        ([0, 4, 5, 2, 6], [0, 3, 1, 2, 4]),  # late
        ([0, 9000, 4, 5], [0, 2, 3]),  # a stamp that jumps
        ([30, 0, 1, 2, 3], [1, 2, 3, 4]),
        ([5, 0, 1, 2, 3], [1, 2, 3, 4, 0]),
        ([0, 20, 40, 60, 80, 10, 30, 50], [0, 1, 2, 3, 4]),  # the clock is set back for good
        ([0, 40, 80, 120, 20, 60, 100, 140, 180], [0, 4, 5, 6, 7, 8]),
        ([0, 0, 5, 0], [0, 1, 3, 2]),
    ],
)
def test_order_in_time(tenths, order):
    assert order_in_time(np.array(tenths, np.int64) * 10**8).tolist() == order


@given(st.lists(st.integers(-3, 6), max_size=9))
def test_longest_non_decreasing_against_all_subsets(values):
    kept = longest_non_decreasing(values)
    chosen = [values[i] for i in kept]
    assert np.all(np.diff(kept) > 0)
    assert chosen == sorted(chosen)
    best = max(
        n
        for n in range(len(values) + 1)
        for subset in combinations(values, n)
        if list(subset) == sorted(subset)
    )
    assert len(kept) == best
