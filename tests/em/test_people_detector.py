"""Legs and bodies in single scans, and whether they have changed places."""

import numpy as np
import pytest
from made_up_scans import ANGLES, before, poses, recording, wall

from stillmap.core import se2
from stillmap.em import people_tracker as detector
from stillmap.em.people_tracker import detect_segments, find_changed


def interval(monkeypatch, seconds):
    monkeypatch.setattr(detector, "_BACKGROUND_INTERVAL", seconds)


def found(ranges):
    r = recording(ranges)
    return detect_segments(r, poses(r))


def test_two_legs_before_a_wall():
    legs = ((3.0, 0.3, 0.07), (3.0, -0.2, 0.07))
    seen = found(before(wall(), *legs))
    assert seen.scan.tolist() == [0, 0]
    np.testing.assert_allclose(seen.xy, [(2.94, -0.2), (2.94, 0.3)], atol=0.03)
    np.testing.assert_allclose(seen.width, 0.14, atol=0.06)


def test_in_the_frame_of_the_map():
    r = recording([wall(), before(wall(), (3.0, 0.0, 0.2))])
    T = np.stack([np.eye(3), se2.matrix(1.0, 2.0, np.pi / 2)])
    seen = detect_segments(r, T)
    assert seen.scan.tolist() == [1]
    np.testing.assert_allclose(seen.xy, [(1.0, 4.85)], atol=0.05)


@pytest.mark.parametrize(
    "things",
    [
        (),
        ((3.0, 0.0, 0.6),),  # too wide
        ((0.4, 0.0, 0.012),),  # too narrow
        ((3.0, 0.0, 0.2), (1.5, 0.12, 0.1)),  # half behind something, which is a feature itself
    ],
)
def test_segments_that_are_no_legs(things):
    seen = found(before(wall(), *things))
    hidden = len(things) == 2
    assert len(seen.scan) == int(hidden)
    if hidden:
        np.testing.assert_allclose(seen.xy, [(1.42, 0.12)], atol=0.05)


def test_corners_and_edges_are_no_detections():
    wide = wall()
    corner = np.minimum(wide, 2.0 / np.maximum(np.sin(np.abs(ANGLES)), 1e-9))  # a corridor's end
    outer = np.where(ANGLES > 0.1, 3.0 / np.cos(ANGLES - 0.1), wide)  # a wall that ends
    niche = np.where(np.abs(ANGLES) < 0.05, 9.0, wide)  # something narrow and farther away
    for ranges in (corner, outer, niche):
        assert len(found(ranges).scan) == 0


def test_segments_at_the_end_of_a_scan_are_no_detections():
    ranges = wall()
    ranges[:3] = ranges[-3:] = 2.0
    assert len(found(ranges).scan) == 0
    begins, ends = np.full((2, 11), 6.0)  # so few that either end of it is near the other
    begins[:2] = ends[-2:] = 3.0
    for scans in ([ends, begins], [begins, ends], [ends, ends], [begins, begins]):
        assert len(found(scans).scan) == 0  # nor has it neighbours in the next scan
    inside = np.roll(begins, 1)
    assert len(found(inside).scan) == 1


def test_detections_beside_missing_and_unusable_beams():
    ranges = np.full(len(ANGLES), np.inf)
    ranges[90:94] = 3.0
    assert len(found(ranges).scan) == 1
    ranges[89] = ranges[94] = np.nan
    assert len(found(ranges).scan) == 1
    assert len(found(np.full(len(ANGLES), np.inf)).scan) == 0
    assert len(found(np.full(len(ANGLES), np.nan)).scan) == 0


def test_the_limits_of_a_segment(monkeypatch):
    ranges = before(wall(), (3.0, 0.0, 0.2))
    for name, value in (
        ("_MIN_SEGMENT_WIDTH", 0.5), ("_MAX_SEGMENT_WIDTH", 0.3), ("_RANGE_JUMP", 4.0)
    ):  # fmt: skip
        with monkeypatch.context() as changed:
            changed.setattr(detector, name, value)
            assert len(found(ranges).scan) == 0


@pytest.mark.parametrize("way", [1, -1])
def test_positions_that_were_free(way, monkeypatch):
    interval(monkeypatch, 1.0)
    pillar = (3.0, 1.0, 0.2)
    scans = [before(wall(), pillar, (3.0, -1.0, 0.2))] + 9 * [before(wall(), pillar)]
    r = recording(scans[::way])
    seen = detect_segments(r, poses(r))
    moved = find_changed(r, poses(r), seen)
    mover = seen.xy[:, 1] < 0
    assert mover.sum() == 1
    np.testing.assert_array_equal(moved, mover)
    with monkeypatch.context() as changed:
        changed.setattr(detector, "_RANGE_JUMP", 4.0)
        assert not find_changed(r, poses(r), seen).any()  # the wall is not so far behind
    interval(monkeypatch, 5.0)
    assert not find_changed(r, poses(r), seen).any()  # no scan is so far away in time


def test_before_or_after_is_enough(monkeypatch):
    interval(monkeypatch, 1.0)
    gone, there = wall(), before(wall(), (3.0, -1.0, 0.2))
    for scans, said in (((gone, there, there), [1, 0]), ((there, there, gone), [0, 1])):
        r = recording(scans, seconds=[0.0, 1.5, 3.0])
        seen = detect_segments(r, poses(r))
        assert find_changed(r, poses(r), seen).tolist() == said


def test_a_thin_post_that_beams_miss_is_not_changed(monkeypatch):
    interval(monkeypatch, 1.0)
    monkeypatch.setattr(detector, "_MIN_SEGMENT_WIDTH", 0.08)
    thick, thin = wall(), wall()
    thick[90:92] = thin[91] = 3.0
    for second, said in ((thin, [False]), (wall(), [True])):
        r = recording([thick, second], seconds=[0.0, 1.5])
        seen = detect_segments(r, poses(r))
        assert find_changed(r, poses(r), seen).tolist() == said


def test_out_of_view_is_not_changed(monkeypatch):
    interval(monkeypatch, 1.0)
    r = recording([before(wall(), (3.0, 0.0, 0.2)), wall()], seconds=[0.0, 1.5])
    for turned, said in ((0.0, True), (np.radians(80), True), (np.radians(120), False)):
        T = np.stack([np.eye(3), se2.matrix(0.0, 0.0, turned)])
        seen = detect_segments(r, T)
        assert find_changed(r, T, seen).tolist() == [said]


def test_only_scans_of_the_same_laser_are_compared(monkeypatch):
    interval(monkeypatch, 1.0)
    scans = [before(wall(), (3.0, -1.0, 0.2)), wall()]
    for sensors, said in (((0, 0), True), ((0, 1), False)):
        r = recording(scans, seconds=[0.0, 1.5], sensor=sensors)
        seen = detect_segments(r, poses(r))
        assert find_changed(r, poses(r), seen).tolist() == [said]
