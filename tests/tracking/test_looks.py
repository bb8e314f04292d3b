"""What a scan says about places: hidden, reached, passed."""

import dataclasses

import numpy as np
import pytest

from stillmap.core.recording import Recording
from stillmap.tracking.looks import Look, classify_looks


def scans_of(ranges, angles):
    """Standing scans of the same angles, rows of ranges."""
    ranges = np.asarray(ranges, float)
    points = ranges[..., None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return Recording(
        stamp_ns=np.arange(len(ranges), dtype=np.int64) * 10**8,
        offset=np.arange(len(ranges) + 1, dtype=np.int64) * len(angles),
        points=points.reshape(-1, 2).astype(np.float32),
        hit=np.isfinite(ranges).ravel(),
        T_odom_base=None,
        T_base_sensor=np.eye(3)[None],
        sensor=np.zeros(len(ranges), np.int32),
    )


ANGLES = np.radians(np.arange(-90.0, 91.0))


def looks_at(ranges, places, T=None, angles=ANGLES):
    recording = scans_of([ranges], angles)
    T = np.eye(3)[None] if T is None else T
    return classify_looks(recording, T, np.zeros(len(places), np.intp), np.array(places)).tolist()


def test_in_front_of_a_wall_at_it_and_behind_it():
    places = [(2.0, 0.0), (4.0, 0.0), (5.0, 0.0)]
    assert looks_at(np.full(181, 4.0), places) == [Look.PASSED, Look.REACHED, Look.HIDDEN]


def test_one_beam_of_three_on_a_leg_counts_less_than_two_that_pass():
    ranges = np.full(181, 6.0)
    ranges[90] = 2.0
    assert looks_at(ranges, [(2.0, 0.0)]) == [Look.PASSED]
    ranges[91] = 2.0
    assert looks_at(ranges, [(2.0, 0.0)]) == [Look.REACHED]


def test_out_of_view_and_without_readings():
    assert looks_at(np.full(181, 4.0), [(-2.0, 0.0)]) == [Look.HIDDEN]
    assert looks_at(np.full(181, np.nan), [(2.0, 0.0)]) == [Look.HIDDEN]


def test_from_where_the_sensor_is_and_turned_to():
    T = np.array([[[0.0, -1.0, 1.0], [1.0, 0.0, 2.0], [0.0, 0.0, 1.0]]])
    ranges = np.full(181, 4.0)  # it looks along +y from (1, 2)
    assert looks_at(ranges, [(1.0, 4.0), (1.0, 6.0), (3.0, 2.0)], T) == [1, 0, 1]


@pytest.mark.parametrize("seed", range(3))
def test_the_order_of_beams_and_of_places_does_not_matter(seed):
    rng = np.random.default_rng(seed)
    ranges, shuffled = rng.uniform(1.0, 8.0, 181), rng.permutation(181)
    places = np.column_stack([rng.uniform(0.5, 8.0, 50), rng.uniform(-4.0, 4.0, 50)])
    found = looks_at(ranges, places)
    assert looks_at(ranges[shuffled], places, angles=ANGLES[shuffled]) == found
    assert looks_at(ranges, places[::-1])[::-1] == found
    assert set(found) == {Look.HIDDEN, Look.REACHED, Look.PASSED}


def test_each_place_is_looked_up_in_its_own_scan():
    recording = scans_of([np.full(181, 1.0), np.full(181, 4.0)], ANGLES)
    scan = np.array([1, 0, 1])
    places = np.array([(2.0, 0.0), (2.0, 0.0), (4.0, 0.0)])
    found = classify_looks(recording, np.tile(np.eye(3), (2, 1, 1)), scan, places)
    assert found.tolist() == [Look.PASSED, Look.HIDDEN, Look.REACHED]


@pytest.mark.parametrize(("lost", "look"), [(1, Look.HIDDEN), (2, Look.HIDDEN), (3, Look.PASSED)])
def test_three_beams_without_a_return_pass_fewer_may_have_been_lost(lost, look):
    # half a degree apart, before a wall of 2 m: the place 2.5 m away is hidden where beams return
    angles = np.radians(np.arange(-90.0, 90.5, 0.5))
    recording = scans_of([np.full(len(angles), 2.0)], angles)
    points, hit = recording.points.copy(), recording.hit.copy()
    some = np.arange(180 - lost // 2, 180 - lost // 2 + lost)
    points[some] *= 15.0
    hit[some] = False
    lossy = dataclasses.replace(recording, points=points, hit=hit)
    place = np.array([[10.0, 0.0]])
    assert classify_looks(lossy, np.eye(3)[None], np.zeros(1, np.intp), place) == [look]
