"""Numbers of rows of which some are dropped."""

import numpy as np
import pytest

from stillmap.live.row_numbers import RowNumbers


@pytest.fixture
def hundred():
    out = RowNumbers()
    for number in range(100):
        out.append(number)
    return out


def test_without_gaps_rows_have_their_own_number(hundred):
    assert len(hundred) == 100
    np.testing.assert_array_equal(hundred.find(np.arange(100)), np.arange(100))
    assert hundred.has(99)
    assert not hundred.has(100)
    assert not RowNumbers().has(0)


def test_rows_are_found_after_others_were_dropped(hundred):
    rng = np.random.default_rng(4)
    left = list(range(100))
    for round_ in range(4):
        n = int(rng.integers(1, len(left)))
        kept = rng.random(n) < 0.5
        hundred.select_last(kept)
        left = left[: len(left) - n] + [k for k, one in zip(left[-n:], kept, strict=True) if one]
        for number in range(100 + 10 * round_, 110 + 10 * round_):
            hundred.append(number)
            left.append(number)
    assert len(hundred) == len(left)
    np.testing.assert_array_equal(hundred.numbers(), left)
    assert [number for number in range(150) if hundred.has(number)] == left
    np.testing.assert_array_equal(hundred.find(np.array(left)), np.arange(len(left)))


def test_a_dropped_row_is_that_of_the_last_one_before(hundred):
    kept = np.ones(90, np.bool_)
    kept[[0, 1, 50]] = False
    hundred.select_last(kept)
    assert hundred.find(np.array([9, 10, 11, 12, 59, 60, 61])).tolist() == [9, 9, 9, 10, 57, 57, 58]
