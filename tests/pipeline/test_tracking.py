"""`tracker` from a recording to a map: registered with all beams, then without the people."""

import numpy as np
import pytest
from choices import RESOLUTION, options

import stillmap
from stillmap import _core, em
from stillmap.em import beam_counting
from stillmap.results.eval.labels import score_labels


@pytest.fixture
def tracked(room):
    return stillmap.build(room.recording, options("tracker"))


def test_labels_are_better_than_calling_everything_static(room, tracked):
    hit, static = room.recording.hit, room.truth.static
    labels = score_labels(tracked.p_static, static, hit)
    everything = score_labels(np.ones(len(hit), np.float32), static, hit)
    assert labels.brier < 0.6 * everything.brier
    assert labels.precision > 0.7
    assert labels.recall > 0.5
    assert set(np.unique(tracked.p_static[hit])) == {0.0, 1.0}


def test_the_second_iterate_is_kept_and_registered_without_people(room, tracked):
    assert [it.number for it in tracked.iterations] == [1, 2]
    assert (tracked.best_iteration, tracked.converged) == (2, True)
    first, second = list(stillmap.iterate(room.recording, options("tracker")))
    assert (first.estimate.weights == 1).all()
    np.testing.assert_array_equal(second.estimate.weights, first.estimate.p_static)
    np.testing.assert_array_equal(tracked.poses, second.estimate.poses)
    np.testing.assert_array_equal(tracked.p_static, second.estimate.p_static)


def test_the_map_counts_hits_that_are_on_nobody(room, tracked):
    grid = _core.OccupancyGrid2D(RESOLUTION)
    em.add_recording(grid, room.recording, tracked.poses, tracked.p_static)
    _, alpha, beta = grid.dense()
    np.testing.assert_array_equal(tracked.map.alpha, alpha.astype(np.float32))
    crossed = alpha + beta > 0
    ratio = np.where(crossed, alpha / np.where(crossed, alpha + beta, 1.0), np.nan)
    threshold = beam_counting.MIN_HIT_RATIO
    occupied = ratio[crossed] >= threshold
    np.testing.assert_array_equal(tracked.map.p_occupied[crossed] == 1.0, occupied)
    assert np.isnan(tracked.map.p_occupied[~crossed]).all()


def test_fewer_cells_are_occupied_than_by_counting_alone(room, monkeypatch):
    monkeypatch.setattr(beam_counting, "MIN_HIT_RATIO", 0.05)
    tracked, counted = (
        stillmap.build(room.recording, options(name), poses=room.truth.T_world_base).map.p_occupied
        for name in ("tracker", "hit-ratio")
    )
    assert not ((tracked == 1.0) & (counted != 1.0)).any()
    assert (tracked == 1.0).sum() < (counted == 1.0).sum() - 20


def test_people_are_objects(tracked):
    assert 1 <= len(tracked.objects) <= 12
