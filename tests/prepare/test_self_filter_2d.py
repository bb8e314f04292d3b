"""Self filter of 2D lasers."""

import numpy as np
import pytest

from stillmap.prepare import max_range
from stillmap.prepare.options import ReadOptions


@pytest.fixture
def readings():
    """100 scans of a robot that moves; beams 0 to 4 end on it."""
    rng = np.random.default_rng(3)
    out = rng.uniform(1.5, 8.0, (100, 60)).astype(np.float32)
    out[:, :5] = 0.3 + rng.normal(0.0, 0.005, (100, 5))
    out[::20, :5] = np.inf
    return out


def test_a_robot_that_sees_itself(readings):
    ((first, last, limit),) = max_range.find_self_sectors(readings, 0.02)
    assert (first, last) == (0, 6)
    assert limit == pytest.approx(0.4, abs=0.01)


def test_its_readings_are_unusable(readings):
    readings[5:10, 3] = 2.0
    readings[:10, 30] = 0.35
    rule, _ = max_range.infer_range_rule(readings, None, ReadOptions())
    length, hit = max_range.apply_range_rule(readings, rule)
    own = readings[:, :5] < 0.4
    assert np.isnan(length[:, :5][own]).all()
    assert not hit[:, :5][own].any()
    assert hit[5:10, 3].all()  # somebody beside the robot
    assert hit[:10, 30].all()  # near, where the robot is not
    kept, _ = max_range.infer_range_rule(readings, None, ReadOptions(self_filter=False))
    assert max_range.apply_range_rule(readings, kept)[1][:, :5][own].all()


def test_a_laser_that_stands_sees_everything_again(readings):
    readings[:] = readings[0]
    assert max_range.find_self_sectors(readings, 0.02) == ()


def test_a_wall_along_the_way_is_no_robot(readings):
    """Half a metre beside the robot for half of the way."""
    readings[:50, 20:30] = 0.5
    assert [part[:2] for part in max_range.find_self_sectors(readings, 0.02)] == [(0, 6)]
