"""Cars are one track each, however fast they come; people are none of them."""

import numpy as np
import pytest
from synthetic_tracks import points_of, watched

from stillmap.tracking import fast_movers
from stillmap.tracking.association import MAX_GAP, assign_tracks
from stillmap.tracking.fast_movers import find_fast_movers

RATE = 10.0
ANGLES = np.radians(np.arange(-90.0, 90.5, 1.0))


def box_hits(x, y, length=4.4, width=1.8):
    """Ranges (n,) along ANGLES to a box along x whose center is given; inf: it is missed."""
    d = np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])
    with np.errstate(divide="ignore"):
        at, half = np.array([x, y]), np.array([length, width]) / 2
        t = np.stack([(at - half) / d, (at + half) / d])
    near, far = t.min(axis=0).max(axis=1), t.max(axis=0).min(axis=1)
    return np.where((near <= far) & (near > 0), near, np.inf)


def driven(cars, seconds, robot_speed=6.0, people=()):
    """What a laser on a robot that drives along x sees of cars: functions of seconds to x, y.

    Returns the points, and whose each is; people come after the cars.
    """
    rng = np.random.default_rng(0)
    t = np.arange(0.0, seconds, 1.0 / RATE)
    rows, sensor = [], np.column_stack([robot_speed * t, np.zeros(len(t))])
    for s, now in enumerate(t):
        sizes = [(4.4, 1.8)] * len(cars) + [(0.4, 0.4)] * len(people)
        at = [np.array(way(now)) - sensor[s] for way in (*cars, *people)]
        ranges = np.array([box_hits(*p, *size) for p, size in zip(at, sizes, strict=True)])
        who, r = ranges.argmin(axis=0), ranges.min(axis=0)
        seen = np.flatnonzero(r < 60.0)
        r = r[seen] + rng.normal(0.0, 0.02, len(seen))
        xy = sensor[s] + r[:, None] * np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])[seen]
        rows.append(np.column_stack([np.full(len(seen), s), xy, who[seen]]))
    scan, x, y, who = np.concatenate(rows).T
    points = points_of(t, scan.astype(np.intp), np.column_stack([x, y]), sensor)
    return points, who.astype(int)


def found(points):
    return find_fast_movers(points, assign_tracks(points, MAX_GAP))


def oncoming(begin, speed, y=3.5):
    return lambda s: (begin - speed * s, y)


@pytest.mark.parametrize("speed", [6.0, 10.0, 16.0])
def test_a_car_that_comes_towards_the_robot_is_one_track_with_its_speed(speed):
    points, _ = driven([oncoming(70.0, speed)], seconds=68.0 / (speed + 6.0))
    owner, (path,) = found(points)
    assert np.mean(owner == owner.max()) > 0.97
    off = np.linalg.norm(path.velocity, axis=1) - speed
    assert np.median(np.abs(off)) < 0.15
    assert np.abs(off).max() < 1.0
    assert path.length == pytest.approx(4.4, abs=0.6)
    truth = np.column_stack([70.0 - speed * path.seconds, np.full(len(path.xy), 3.5)])
    assert np.median(np.linalg.norm(path.xy - truth, axis=1)) < 0.5


def test_a_car_that_overtakes_is_followed_by_its_rear():
    points, _ = driven([lambda s: (2.0 + 12.0 * s, 3.5)], seconds=6.0)
    owner, (path,) = found(points)
    assert np.mean(owner == owner.max()) > 0.95
    assert np.median(np.linalg.norm(path.velocity, axis=1)) == pytest.approx(12.0, abs=0.2)


def test_cars_in_file_are_as_many_tracks():
    points, who = driven([oncoming(40.0, 9.0), oncoming(53.0, 9.0), oncoming(66.0, 9.0)], 4.0)
    owner, paths = found(points)
    assert len(paths) == 3
    tracks = [np.bincount(owner[who == k]).argmax() for k in range(3)]
    assert len(set(tracks)) == 3
    assert all(np.mean(owner[who == k] == tracks[k]) > 0.9 for k in range(3))


def test_somebody_on_the_pavement_keeps_his_track_while_a_car_passes():
    walker = lambda s: (24.0 + 1.2 * s, 6.0)  # noqa: E731
    points, who = driven([oncoming(60.0, 10.0)], 2.6, people=[walker])
    before = assign_tracks(points, MAX_GAP)
    owner, (path,) = found(points)
    assert (owner[who == 1] < owner.max()).mean() > 0.95
    assert (owner[who == 1] == before[who == 1]).mean() > 0.95
    assert np.median(np.linalg.norm(path.velocity, axis=1)) == pytest.approx(10.0, abs=0.3)


@pytest.mark.parametrize(
    ("n", "reach", "speed", "share"), [(12, 6.0, 1.6, 0.7), (40, 12.0, 0.0, 0.2)]
)
def test_people_and_hits_here_and_there_are_no_fast_movers(n, reach, speed, share):
    rng = np.random.default_rng(1)
    begin, velocity = rng.uniform(-reach, reach, (n, 2)), rng.uniform(-speed, speed, (n, 2))
    ways = [lambda s, a=a, v=v: a + v * s for a, v in zip(begin, velocity, strict=True)]
    points, _ = watched(ways, visible=lambda *_: rng.random() < share)
    before = assign_tracks(points, MAX_GAP)
    owner, paths = find_fast_movers(points, before)
    assert not paths
    assert np.array_equal(owner, before)


@pytest.mark.parametrize("pairs", [1, 7])
def test_pairs_of_looks_in_pieces_make_no_difference(monkeypatch, pairs):
    points, _ = driven([oncoming(40.0, 9.0), oncoming(53.0, 9.0)], 3.0)
    owner, paths = found(points)
    monkeypatch.setattr(fast_movers, "_MAX_PAIRS", pairs)
    again, others = found(points)
    np.testing.assert_array_equal(again, owner)
    assert len(others) == len(paths) == 2
    for one, other in zip(paths, others, strict=True):
        np.testing.assert_array_equal(one.xy, other.xy)
