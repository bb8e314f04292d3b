"""Where tracks are cut, and whose the points between are."""

import numpy as np
from synthetic_tracks import watched

from stillmap.tracking.detections import collect_centroids
from stillmap.tracking.tracklets import assign_to_paths, cut_tracks

NONE = np.zeros(0, int)


def meeting(y=0.0, **more):
    """Two who walk towards one another and meet at 4 s, beside the laser."""
    ways = [lambda t: (t - 4.0, 5.0 + y), lambda t: (4.0 - t, 5.0)]
    points, who = watched(ways, **more)
    return points, who, collect_centroids(points, who)


def test_both_are_cut_where_they_meet():
    points, _, found = meeting(0.4)
    piece = cut_tracks(found, points.seconds, NONE)
    apart = np.abs(2.0 * (points.seconds[found.scan] - 4.0))
    assert (piece[np.hypot(apart, 0.4) < 0.5] == -1).all()
    assert (piece[np.hypot(apart, 0.4) > 0.7] >= 0).all()
    assert set(piece.tolist()) == {-1, 0, 1, 2, 3}
    assert (found.track[piece < 2] == 0)[piece[piece < 2] >= 0].all()


def test_who_passes_farther_off_is_not_cut():
    points, _, found = meeting(1.0)
    np.testing.assert_array_equal(cut_tracks(found, points.seconds, NONE), found.track)


def test_who_stays_beside_another_is_not_cut():
    points, who = watched([lambda t: (t - 4.0, 5.0), lambda t: (t - 4.0, 5.4)])
    found = collect_centroids(points, who)
    np.testing.assert_array_equal(cut_tracks(found, points.seconds, NONE), found.track)


def test_a_track_is_cut_at_gaps_unless_it_is_whole():
    points, who = watched([lambda t: (t - 4.0, 5.0)], lambda _, t: not 3.0 < t < 4.1)
    found = collect_centroids(points, who)
    piece = cut_tracks(found, points.seconds, NONE)
    np.testing.assert_array_equal(piece, points.seconds[found.scan] > 3.5)
    np.testing.assert_array_equal(cut_tracks(found, points.seconds, np.array([0])), 0 * piece)


def test_points_of_an_encounter_go_to_the_nearest_path():
    points, who, found = meeting(0.4)
    piece = cut_tracks(found, points.seconds, NONE)
    own = piece >= 0
    outside = found._make(column[own] for column in found)
    rest = np.flatnonzero(np.abs(points.seconds[points.scan] - 4.0) < 0.4)
    nearest = assign_to_paths(points, rest, outside, outside.track)
    assert np.mean(nearest == who[rest]) > 0.9
    far = np.flatnonzero(points.scan == 0)
    only = outside.track == 0
    early = outside._make(column[only] for column in outside)
    assert (assign_to_paths(points, far[who[far] == 1], early, early.track) == -1).all()


def test_nothing_to_cut():
    points, _, found = meeting()
    none = found._make(column[:0] for column in found)
    assert len(cut_tracks(none, points.seconds, NONE)) == 0
    assert len(assign_to_paths(points, NONE, none, NONE)) == 0
