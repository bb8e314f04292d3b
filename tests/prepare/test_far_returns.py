"""Returns from farther away than a map follows beams."""

import numpy as np
import pytest
from recordings import of_one_sensor

from stillmap.core.source import RangeRule, SensorNotes
from stillmap.prepare.plausibility import (
    leave_out_far_returns,
    mapped_range,
    shorten_far_beams,
    stated_max_range,
)


def scan(lengths, hit, dimension=2):
    points = np.zeros((len(lengths), dimension), np.float32)
    points[:, 1] = lengths
    stamp, offset = np.zeros(1, np.int64), np.array([0, len(points)])
    return of_one_sensor(stamp, offset, points, np.array(hit, bool))


@pytest.mark.parametrize(
    ("dimension", "cell", "max_range", "reach"),
    [
        (2, 0.05, None, 100.0),
        (2, 0.02, None, 100.0),
        (2, 0.3, None, 600.0),
        (2, 0.05, 250.0, 250.0),
        (2, 0.05, 30.0, 100.0),
        (3, 0.125, None, 1000.0),
        (3, 0.5, None, 4000.0),
    ],
)
def test_mapped_range(dimension, cell, max_range, reach):
    assert mapped_range(dimension, cell, max_range) == reach


@pytest.mark.parametrize(
    ("how", "stated"),
    [
        ("given", 250.0),
        ("declared in the recording; 250.00 m repeats", 250.0),
        ("250.00 m repeats at the top of the readings (9 x)", None),
    ],
)
def test_what_is_said_of_the_laser_is_believed(how, stated):
    recording = scan([5.0], [True])
    rule = RangeRule(250.0, how, "unusable", None, 0.0)
    recording.source.sensors = [SensorNotes(ranges=rule)]
    assert stated_max_range(recording) == stated


def test_what_is_near_stays():
    near = scan([1.0, 81.9, np.nan, 99.9], [True, True, False, False])
    assert leave_out_far_returns(near, 0.05) == (near, [])


@pytest.mark.parametrize(("dimension", "far"), [(2, 101.0), (3, 1300.0)])
def test_far_returns_are_not_used(dimension, far):
    recording = scan([5.0, far, np.nan, far, far], [True, True, False, True, False], dimension)
    found, (sentence,) = leave_out_far_returns(recording, 0.05)
    assert found.hit.tolist() == [True, False, False, False, False]
    np.testing.assert_allclose(found.points[:, 1], [5.0, np.nan, np.nan, np.nan, 5.0])
    assert sentence.startswith("2 of 3 returns are farther than ")
    assert ("read.max_range" if dimension == 2 else "slam.voxel_size") in sentence
    assert recording.hit.sum() == 3  # the input stays


def test_beams_of_one_scan():
    one = scan([5.0, 101.0, np.nan, 200.0], [True, True, False, False])
    points, hit = shorten_far_beams(one.points, one.hit, 100.0)
    np.testing.assert_allclose(points[:, 1], [5.0, np.nan, np.nan, 100.0])
    assert hit.tolist() == [True, False, False, False]
    assert shorten_far_beams(one.points[:1], one.hit[:1], 100.0)[0].base is one.points
