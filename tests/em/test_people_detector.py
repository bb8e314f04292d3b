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


def test_out_of_view_is_not_changed(monkeypatch):
    interval(monkeypatch, 1.0)
    r = recording([before(wall(), (3.0, 0.0, 0.2)), wall()], seconds=[0.0, 1.5])
    for turned, said in ((0.0, True), (np.radians(80), True), (np.radians(120), False)):
        T = np.stack([np.eye(3), se2.matrix(0.0, 0.0, turned)])
        seen = detect_segments(r, T)
        assert find_changed(r, T, seen).tolist() == [said]
