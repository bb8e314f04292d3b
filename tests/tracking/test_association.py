"""Things that are made up: whose each point is."""

import dataclasses

import numpy as np
import pytest
from synthetic_tracks import one_each, watched

from stillmap.tracking import tracklets
from stillmap.tracking.association import assign_tracks
from stillmap.tracking.tracklets import stitch_tracklets

MAX_GAP = 2.0


def found(points):
    return stitch_tracklets(points, assign_tracks(points, MAX_GAP))[0]


def straight(x, y, vx, vy):
    return lambda t: (x + vx * t, y + vy * t)


ALONE, BESIDE = straight(2, 1, 1.2, 0.1), straight(2, 1, 1.0, 0.3)
CROSSING = [straight(3, -4, 0.0, 1.1), straight(7.0, 0.4, -1.1, 0.0)]  # 0.4 m past one another


@pytest.mark.parametrize(
    "ways",
    [
        [ALONE],
        [BESIDE, straight(2, 1.8, 1.0, 0.3)],
        [BESIDE, straight(2, 2.5, 1.0, 0.3)],
        CROSSING,
    ],
    ids=["alone", "beside", "apart", "crossing"],
)
@pytest.mark.parametrize("seed", range(4))
def test_each_has_a_track(ways, seed):
    points, who = watched(ways, seed=seed)
    assert one_each(found(points), who)


@pytest.mark.parametrize(
    ("first", "last", "tracks"), [(3.0, 3.6, 1), (3.0, 4.4, 1), (3.0, 5.4, 1), (1.4, 6.2, 2)]
)
def test_one_that_is_hidden_for_a_while_is_the_same(first, last, tracks):
    points, _ = watched([straight(3, -4, 0.1, 1.0)], lambda _, t: not first < t < last)
    assert len(np.unique(found(points))) == tracks


def test_who_comes_out_from_behind_one_that_stands():
    # the walker appears half a metre beside who stands there, and is one with it for a while
    stands = straight(3.0, 0.0, 0.0, 0.0)
    points, who = watched([stands, straight(3.2, -2.35, 0.0, 0.7)], lambda i, t: i == 0 or t > 2.7)
    near = np.linalg.norm(points.xy[who == 1][0] - [3.0, 0.0])
    assert near < 0.6
    owner = found(points)
    first = owner[(who == 0) & (points.scan == 0)][0]
    assert (owner[who == 0] == first).mean() > 0.97
    walker = owner[who == 1]
    numbers, count = np.unique(walker[walker != first], return_counts=True)
    assert count.max() > 0.9 * len(walker)
    assert len(numbers) == 1


def test_legs_are_one_thing():
    # 0.5 m apart at most, and each hides the other at times
    def leg(side):
        return lambda t: (2 + 0.9 * t + side * 0.24 * np.sin(5.0 * t), 1.0 + side * 0.09)

    def visible(i, t):
        return (t * 2.3 + 0.5 * i) % 1.0 < 0.75

    points, _ = watched([leg(1.0), leg(-1.0)], visible, points=2, radius=0.06)
    assert len(np.unique(found(points))) == 1


def test_a_long_thing_is_one():
    parts = [straight(x, 6, 2.5, 0.0) for x in np.arange(-8.0, -4.0, 0.5)]
    points, _ = watched(parts, points=4, radius=0.2)
    assert len(np.unique(found(points))) == 1


def test_short_tracks_are_not_confirmed(monkeypatch):
    points, _ = watched([straight(2, 1, 1.0, 0.0)], lambda _, t: t < 0.45)
    assert (found(points) == -1).all()
    monkeypatch.setattr(tracklets, "MIN_TRACK_SCANS", 2)
    monkeypatch.setattr(tracklets, "_MIN_DURATION", 0.3)
    assert (found(points) == 0).all()


def test_many_things_each_get_their_own():
    rng = np.random.default_rng(5)
    start = np.array([(x, y) for x in range(3, 15, 3) for y in range(-9, 10, 3)], float)
    speed = rng.uniform(-0.15, 0.15, start.shape)
    ways = [straight(*p, *v) for p, v in zip(start, speed, strict=True)]
    points, who = watched(ways, seconds=6.0)
    assert one_each(found(points), who)


def test_turned_and_moved_worlds_give_the_same():
    ways = [straight(3, -4, 0.2, 1.1), straight(7.0, 0.4, -1.1, 0.1), straight(4, 3, 0.4, -0.8)]
    points, _ = watched(ways)
    c, s = np.cos(0.7), np.sin(0.7)
    turned = points.xy @ np.array([[c, s], [-s, c]]) + [100.0, -50.0]
    other = dataclasses.replace(points, xy=turned)
    np.testing.assert_array_equal(found(other), found(points))


@pytest.mark.parametrize("angle", [0.5, 0.7, 1.0])
def test_tracks_that_were_exchanged_behind_one_another_are_set_right(angle):
    vx, vy = 1.2 * np.cos(angle), 1.2 * np.sin(angle)
    one, other = (straight(x - 4.0 * vx, -4.0 * v, vx, v) for x, v in ((6.0, vy), (6.1, -vy)))
    points, who = watched([one, other])
    exchanged = np.where(points.seconds[points.scan] < 4.0, who, 1 - who)
    assert not one_each(exchanged, who)
    owner, p_identity = stitch_tracklets(points, exchanged)
    apart = np.abs(points.seconds[points.scan] - 4.0) > 1.5
    assert one_each(owner[apart], who[apart])
    assert (p_identity[np.unique(owner[apart])] > 0.8).all()
