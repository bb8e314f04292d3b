"""Segments of a scan: widths, and what lies beside their ends."""

import numpy as np
import pytest

from stillmap.core.chunks import ScanBeams
from stillmap.em.shape_evidence import (
    _BOTH_FARTHER,
    _BOTH_NEARER,
    _ONE_FARTHER,
    _UNKNOWN,
    N_SEGMENT_TYPES,
    classify_segments,
    find_lost_beams,
)

STEP = np.radians(0.5)
NO_RETURN, UNUSABLE = 0.0, -1.0


def scans(*ranges):
    """Scans of beams half a degree apart; NO_RETURN: at 30 m without a return."""
    points, hit = [], []
    for some in ranges:
        some = np.asarray(some, float)
        angle = STEP * np.arange(len(some))
        reach = np.where(some == NO_RETURN, 30.0, np.where(some == UNUSABLE, np.nan, some))
        points.append(reach[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]))
        hit.append(some > 0.0)
    n = [len(some) for some in ranges]
    T = np.tile(np.eye(3), (len(n), 1, 1))
    ends = np.concatenate(points).astype(np.float32)
    return ScanBeams(ends, np.concatenate(hit), np.append(0, np.cumsum(n)), T)


def parts(types):
    """Width and depth order of some types."""
    return types // 4, types % 4


def test_a_leg_before_a_wall():
    # 0.105 m wide; the wall goes on behind it, and beyond both ends of the scan
    found = classify_segments(scans([6.0] * 40 + [4.0] * 4 + [6.0] * 40))
    width, order = parts(found)
    assert (found >= 0).all()
    assert (found < N_SEGMENT_TYPES).all()
    assert set(order[40:44]) == {_BOTH_FARTHER}
    assert set(width[40:44]) == {0}
    assert set(order[:40]) == set(order[44:]) == {_UNKNOWN}
    assert set(width[:40]) == {5}  # 2 m


def test_depth_orders():
    found = classify_segments(scans([3.0] * 9 + [5.0] * 9 + [4.0] * 9 + [8.0] * 9 + [7.0] * 9))
    _, order = parts(found)
    assert order[::9].tolist() == [_UNKNOWN, _BOTH_NEARER, _BOTH_FARTHER, _BOTH_NEARER, _UNKNOWN]
    found = classify_segments(scans([3.0] * 9 + [4.0] * 9 + [5.0] * 9))
    assert parts(found)[1][9] == _ONE_FARTHER


@pytest.mark.parametrize(
    ("beams", "width"), [(1, 0), (4, 0), (6, 1), (13, 2), (20, 3), (30, 4), (60, 5)]
)
def test_widths(beams, width):
    found = classify_segments(scans([9.0] * 5 + [4.0] * beams + [9.0] * 5))
    assert set(parts(found[5:-5])[0]) == {width}


def test_three_beams_without_a_return_are_free_space_one_is_nothing():
    row = [5.0] * 9
    one, three = (
        classify_segments(scans(row + [NO_RETURN] * n + row + [NO_RETURN] * n + row))
        for n in (1, 3)
    )
    assert (one[one >= 0] == one[0]).all()  # one segment
    assert (one < 0).sum() == 2
    middle = parts(three[12:21])
    assert set(middle[1]) == {_BOTH_FARTHER}


def test_unusable_beams_are_as_if_they_were_not_there():
    rng = np.random.default_rng(0)
    row = np.repeat(rng.uniform(2.0, 9.0, 20), 5)
    whole = classify_segments(scans(row))
    with_gaps = np.insert(row, np.arange(1, 100, 3), UNUSABLE)
    # the beams turn a little farther, so a width may reach the next class
    found = classify_segments(scans(with_gaps))
    np.testing.assert_array_equal(found[with_gaps == UNUSABLE], -1)
    np.testing.assert_array_equal(found[with_gaps != UNUSABLE] % 4, whole % 4)


def test_scans_do_not_touch():
    row = [5.0] * 30
    both, alone = classify_segments(scans(row, row)), classify_segments(scans(row))
    np.testing.assert_array_equal(both, np.concatenate([alone, alone]))
    np.testing.assert_array_equal(
        classify_segments(scans(row, [], row)), np.concatenate([alone, alone])
    )


def test_nothing_to_classify():
    assert classify_segments(scans([])).shape == (0,)
    assert (classify_segments(scans([NO_RETURN] * 9)) == -1).all()
    assert (classify_segments(scans([UNUSABLE] * 9)) == -1).all()


def test_lost_beams():
    data = scans([5.0, NO_RETURN, NO_RETURN, 5.0, NO_RETURN, NO_RETURN, NO_RETURN], [NO_RETURN])
    scan = np.repeat([0, 1], [7, 1])
    found = find_lost_beams(data.hit, data.points, scan)
    assert found.tolist() == [False, True, True, False, False, False, False, True]
