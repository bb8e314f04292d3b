"""People: legs and bodies in single scans, and their tracks; what stands is not labelled."""

import numpy as np
import pytest
from made_up import ANGLES, at_origin, before, crossing, recording_of, wall

from stillmap import _core, em
from stillmap.core import se2
from stillmap.em import people_tracker
from stillmap.em.people_tracker import detect_segments, find_changed, label_people, track_people


def found(ranges):
    r = recording_of(ranges)
    return detect_segments(r, at_origin(r))


def test_two_legs_before_a_wall():
    seen = found(before(wall(), (3.0, 0.3, 0.07), (3.0, -0.2, 0.07)))
    assert seen.scan.tolist() == [0, 0]
    np.testing.assert_allclose(seen.xy, [(2.94, -0.2), (2.94, 0.3)], atol=0.03)
    np.testing.assert_allclose(seen.width, 0.14, atol=0.06)


def test_in_the_frame_of_the_map():
    r = recording_of([wall(), before(wall(), (3.0, 0.0, 0.2))])
    T = np.stack([np.eye(3), se2.matrix(1.0, 2.0, np.pi / 2)])
    seen = detect_segments(r, T)
    assert seen.scan.tolist() == [1]
    np.testing.assert_allclose(seen.xy, [(1.0, 4.85)], atol=0.05)


def test_segments_that_are_no_legs():
    wide = wall()
    corner = np.minimum(wide, 2.0 / np.maximum(np.sin(np.abs(ANGLES)), 1e-9))  # a corridor's end
    outer = np.where(ANGLES > 0.1, 3.0 / np.cos(ANGLES - 0.1), wide)  # a wall that ends
    niche = np.where(np.abs(ANGLES) < 0.05, 9.0, wide)  # something narrow and farther away
    too_wide, too_narrow = before(wide, (3.0, 0.0, 0.6)), before(wide, (0.4, 0.0, 0.012))
    for ranges in (wide, corner, outer, niche, too_wide, too_narrow):
        assert len(found(ranges).scan) == 0
    # half behind something, which is a feature itself
    np.testing.assert_allclose(
        found(before(wide, (3.0, 0.0, 0.2), (1.5, 0.12, 0.1))).xy, [(1.42, 0.12)], atol=0.05
    )


@pytest.mark.parametrize("way", [1, -1])
def test_positions_that_were_free(way, monkeypatch):
    monkeypatch.setattr(people_tracker, "_BACKGROUND_INTERVAL", 1.0)
    pillar = (3.0, 1.0, 0.2)
    scans = [before(wall(), pillar, (3.0, -1.0, 0.2))] + 9 * [before(wall(), pillar)]
    r = recording_of(scans[::way])
    seen = detect_segments(r, at_origin(r))
    moved = find_changed(r, at_origin(r), seen)
    mover = seen.xy[:, 1] < 0
    assert mover.sum() == 1
    np.testing.assert_array_equal(moved, mover)
    with monkeypatch.context() as changed:
        changed.setattr(people_tracker, "_RANGE_JUMP", 4.0)
        assert not find_changed(r, at_origin(r), seen).any()  # the wall is not so far behind
    monkeypatch.setattr(people_tracker, "_BACKGROUND_INTERVAL", 5.0)
    assert not find_changed(r, at_origin(r), seen).any()  # no scan is so far away in time


def test_out_of_view_is_not_changed(monkeypatch):
    monkeypatch.setattr(people_tracker, "_BACKGROUND_INTERVAL", 1.0)
    r = recording_of([before(wall(), (3.0, 0.0, 0.2)), wall()], seconds=[0.0, 1.5])
    for turned, said in ((0.0, True), (np.radians(80), True), (np.radians(120), False)):
        T = np.stack([np.eye(3), se2.matrix(0.0, 0.0, turned)])
        seen = detect_segments(r, T)
        assert find_changed(r, T, seen).tolist() == [said]


TIMES = np.arange(0.0, 3.4, 0.2)
PILLAR = (2.0, 2.6, 0.15)


def labelled(r):
    return label_people(r, at_origin(r)).reshape(r.n_scans, -1)


def test_walkers_are_labelled_from_the_first_scan():
    ranges, on = crossing(TIMES, pillar=PILLAR)
    off = labelled(recording_of(ranges))
    assert off[on].mean() > 0.95
    assert off[0][on[0]].all()  # looking back
    assert not off[~on].any()  # wall and pillar are far from him
    # what stands is not labelled
    ranges = np.tile(before(wall(), PILLAR, (3.0, 0.0, 0.2)), (20, 1))
    rng = np.random.default_rng(0)
    assert not labelled(recording_of(ranges + rng.normal(scale=0.02, size=ranges.shape))).any()


def test_tracks_bridge_occlusion_and_end_at_the_last_detection():
    ranges, _ = crossing(TIMES)
    hidden = ranges.copy()
    hidden[7:10] = wall()
    hidden[14:] = wall()
    segments = found(hidden)
    tracks = track_people(segments, np.ones(len(segments.scan), bool), TIMES)
    assert len(np.unique(tracks.track)) == 1
    assert tracks.scan.tolist() == list(range(14))
    assert (~tracks.observed).nonzero()[0].tolist() == [7, 8, 9]
    y = -2.0 + 1.2 * TIMES[:14]
    assert np.abs(tracks.xy[:, 1] - y).max() < 0.35


def test_crossing_walkers():
    one, on_one = crossing(TIMES, x=3.0)
    two, on_two = crossing(TIMES, speed=-1.2, x=4.0, start=2.0)
    off = labelled(recording_of(np.minimum(one, two)))
    assert off[on_one].mean() > 0.9
    assert off[on_two & ~on_one].mean() > 0.85


def test_labels_are_hard_and_the_map_counts_the_others():
    ranges, _ = crossing(TIMES, pillar=PILLAR)
    ranges[:, 170] = np.inf
    ranges[:, 175] = np.nan
    r = recording_of(ranges)
    grid = _core.OccupancyGrid2D(0.1)
    em.add_recording(grid, r, at_origin(r), None)
    found = em.e_step(r, at_origin(r), grid, "tracker", em.EmOptions(), threads=1)
    e = found.p_static.reshape(ranges.shape)
    off = labelled(r)
    hit = np.isfinite(ranges)
    np.testing.assert_array_equal(e[hit], np.where(off, 0.0, 1.0)[hit])
    assert (e[:, 170] == np.float32(em.EmOptions().prior)).all()
    assert np.isnan(e[:, 175]).all()
    assert not (off & ~hit).any()
    # only cells that something else was hit in are known, and its ratio decides
    grid = _core.OccupancyGrid2D(0.1)
    em.add_recording(grid, r, at_origin(r), found.p_static)
    m = em.make_occupancy_map(grid, found.occupied)
    column, row = np.floor((r.points[r.hit] - m.origin[:2]) / 0.1).astype(int).T
    p_occupied, is_kept = m.p_occupied[row, column], found.p_static[r.hit] == 1.0
    assert (p_occupied[~is_kept] == 0.0).all()
    assert (p_occupied[is_kept] == 1.0).mean() > 0.9
    assert found.likelihood.expected <= found.likelihood.bound < 0.0
