"""Segments of a scan: widths, and what lies beside their ends."""

import numpy as np

from stillmap.core.chunks import ScanBeams
from stillmap.em.shape_evidence import (
    _BOTH_FARTHER,
    _UNKNOWN,
    N_SEGMENT_TYPES,
    classify_segments,
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
