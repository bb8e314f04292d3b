"""Tracked people are labelled, what stands is not."""

import numpy as np
from made_up_scans import before, crossing, poses, recording, wall

from stillmap import _core, em
from stillmap.em.people_tracker import (
    detect_segments,
    label_people,
    track_people,
)

TIMES = np.arange(0.0, 3.4, 0.2)
PILLAR = (2.0, 2.6, 0.15)


def labelled(r):
    return label_people(r, poses(r)).reshape(r.n_scans, -1)


def tracks_of(r):
    """The tracks of people."""
    found = detect_segments(r, poses(r))
    seconds = 1e-9 * (r.stamp_ns - r.stamp_ns[0])
    return track_people(found, np.ones(len(found.scan), bool), seconds)


def test_walkers_are_labelled_from_the_first_scan():
    ranges, on = crossing(TIMES, pillar=PILLAR)
    off = labelled(recording(ranges))
    assert off[on].mean() > 0.95
    assert off[0][on[0]].all()  # looking back
    assert not off[~on].any()  # wall and pillar are far from him


def test_standing_objects_are_not_labelled():
    ranges = np.tile(before(wall(), PILLAR, (3.0, 0.0, 0.2)), (20, 1))
    rng = np.random.default_rng(0)
    assert not labelled(recording(ranges + rng.normal(scale=0.02, size=ranges.shape))).any()


def test_tracks_bridge_occlusion_and_end_at_the_last_detection():
    ranges, _ = crossing(TIMES)
    hidden = ranges.copy()
    hidden[7:10] = wall()
    hidden[14:] = wall()
    tracks = tracks_of(recording(hidden))
    assert len(np.unique(tracks.track)) == 1
    assert tracks.scan.tolist() == list(range(14))
    assert (~tracks.observed).nonzero()[0].tolist() == [7, 8, 9]
    y = -2.0 + 1.2 * TIMES[:14]
    assert np.abs(tracks.xy[:, 1] - y).max() < 0.35


def test_crossing_walkers():
    one, on_one = crossing(TIMES, x=3.0)
    two, on_two = crossing(TIMES, speed=-1.2, x=4.0, start=2.0)
    off = labelled(recording(np.minimum(one, two)))
    assert off[on_one].mean() > 0.9
    assert off[on_two & ~on_one].mean() > 0.85


def e_step(r, threads=1, **options):
    grid = _core.OccupancyGrid2D(0.1)
    em.add_recording(grid, r, poses(r), None)
    chosen = em.EmOptions(**options)
    return em.e_step(r, poses(r), grid, "tracker", chosen, threads=threads)


def test_labels_are_hard_and_the_map_counts_the_others():
    ranges, _ = crossing(TIMES, pillar=PILLAR)
    ranges[:, 170] = np.inf
    ranges[:, 175] = np.nan
    r = recording(ranges)
    found = e_step(r)
    e = found.p_static.reshape(ranges.shape)
    off = labelled(r)
    hit = np.isfinite(ranges)
    np.testing.assert_array_equal(e[hit], np.where(off, 0.0, 1.0)[hit])
    assert (e[:, 170] == np.float32(em.EmOptions().prior)).all()
    assert np.isnan(e[:, 175]).all()
    assert not (off & ~hit).any()
    # only cells that something else was hit in are known, and its ratio decides
    grid = _core.OccupancyGrid2D(0.1)
    em.add_recording(grid, r, poses(r), found.p_static)
    m = em.make_occupancy_map(grid, found.occupied)
    x, y, _ = m.origin
    points = r.points[r.hit & (found.p_static == 0.0)]
    cells = np.floor((points - [x, y]) / 0.1).astype(int)[:, ::-1]
    assert (m.p_occupied[tuple(cells.T)] == 0.0).all()
    kept = r.points[r.hit & (found.p_static == 1.0)]
    cells = np.floor((kept - [x, y]) / 0.1).astype(int)[:, ::-1]
    assert (m.p_occupied[tuple(cells.T)] == 1.0).mean() > 0.9
    assert found.likelihood.expected <= found.likelihood.bound < 0.0


def test_the_same_to_the_bit_with_any_number_of_threads():
    ranges, _ = crossing(TIMES, pillar=PILLAR)
    r = recording(ranges)
    first = e_step(r)
    for threads in (1, 2, 3):
        again = e_step(r, threads)
        assert again.p_static.tobytes() == first.p_static.tobytes()
        assert again.likelihood == first.likelihood
        assert again.occupied.p_occupied.tobytes() == first.occupied.p_occupied.tobytes()
