"""What moves, as it is tracked scan by scan."""

import numpy as np
import pytest

from stillmap.core import se2
from stillmap.live.movers import MoverTracker
from stillmap.live.scan import ScanBeams

PERIOD = 0.1  # s


def disk(center, radius=0.25, n=20):
    """(n, D) points on the side of an upright cylinder that the origin sees, at all heights."""
    center = np.asarray(center, float)
    toward = np.arctan2(-center[1], -center[0])
    angle = toward + np.linspace(-1.4, 1.4, n)
    points = center[:2] + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    if len(center) == 2:
        return points
    heights = np.linspace(-0.8, 0.8, 17)
    return np.concatenate([np.c_[points, np.full(n, center[2] + z)] for z in heights])


def scan(stamp, *dynamic, static=(), sensor=0, T_base_sensor=None):
    """A scan, and P(static) of its beams."""
    points = np.concatenate([*dynamic, *static]).astype(np.float32)
    D = points.shape[1]
    hit = np.ones(len(points), bool)
    mount = np.eye(D + 1) if T_base_sensor is None else T_base_sensor
    p_static = np.ones(len(points), np.float32)
    p_static[: sum(map(len, dynamic))] = 0.1
    return ScanBeams(round(1e9 * stamp) + 10**18, points, hit, mount, sensor), p_static


def push(tracker, labelled, T=None):
    beams, p_static = labelled
    tracker.add(beams, np.eye(beams.dimension + 1) if T is None else T, p_static)


def follow(tracker, paths, seconds, *, T=None, static=(), start=0.0):
    """What moves at the end of so many seconds in which points at `paths` (t) are dynamic."""
    D = len(paths[0](0.0))
    for k in range(round(seconds / PERIOD)):
        t = start + k * PERIOD
        push(tracker, scan(t, *(disk(path(t)) for path in paths), static=static), T)
    return tracker.movers(np.eye(D + 1))


def walk(start, velocity):
    return lambda t: np.array(start) + t * np.array(velocity)


@pytest.mark.parametrize(
    ("start", "velocity"), [((4.0, -1.0), (-0.4, 1.0)), ((4.0, -1.0, 1.0), (-0.4, 1.0, 0.0))]
)
def test_a_walker_is_found_within_a_second(start, velocity):
    tracker = MoverTracker(len(start))
    (mover,) = follow(tracker, [walk(start, velocity)], 1.0)
    assert np.linalg.norm(mover.position - walk(start, velocity)(0.9)) < 0.2
    assert mover.age == pytest.approx(0.9)
    (mover,) = follow(tracker, [walk(start, velocity)], 1.0, start=1.0)
    np.testing.assert_allclose(mover.velocity, velocity, atol=0.15)
    assert mover.radius == pytest.approx(0.25, abs=0.06)
    D = len(start)
    assert mover.covariance.shape == (2 * D, 2 * D)
    assert np.linalg.eigvalsh(mover.covariance).min() > 0.0
    error = np.r_[mover.position - walk(start, velocity)(1.9), mover.velocity - velocity]
    assert error @ np.linalg.solve(mover.covariance, error) < 4.0 * D


def test_nobody_who_stands_is_a_mover():
    rng = np.random.default_rng(0)
    place = np.array([3.0, 1.0])
    assert not follow(MoverTracker(2), [lambda _: place + rng.normal(0.0, 0.03, 2)], 20.0)


def test_a_mover_that_stops_stays_one_until_a_second_after_it_was_seen():
    tracker = MoverTracker(2)
    follow(tracker, [walk((3.0, -2.0), (0.0, 1.0))], 2.0)
    (mover,) = follow(tracker, [lambda _: np.array([3.0, 0.0])], 5.0, start=2.0)
    assert mover.number == 0
    assert np.linalg.norm(mover.velocity) < 0.1
    for t, expected in ((7.5, 1), (8.5, 0)):
        push(tracker, scan(t, np.zeros((0, 2))))
        assert len(tracker.movers(np.eye(3))) == expected


def test_two_who_cross_keep_their_numbers():
    paths = [walk((4.0, -2.0), (0.0, 1.0)), walk((4.8, 2.0), (0.0, -1.0))]
    tracker = MoverTracker(2)
    before = {m.number: m.velocity[1] for m in follow(tracker, paths, 1.5)}
    after = {m.number: m.velocity[1] for m in follow(tracker, paths, 2.5, start=1.5)}
    assert before.keys() == after.keys()
    assert all(np.sign(after[number]) == np.sign(before[number]) for number in before)
    assert len(after) == 2


def test_parts_of_walls_that_are_taken_for_dynamic_are_no_movers():
    wall = np.stack([np.full(400, 3.0), np.linspace(-4.0, 4.0, 400)], axis=1)
    tracker = MoverTracker(2)
    for k in range(30):
        here = np.abs(wall[:, 1] + 1.0 - k * PERIOD) < 0.05  # wanders along the wall
        push(tracker, scan(k * PERIOD, wall[here], static=[wall[~here]]))
    assert not tracker.movers(np.eye(3))


def test_tracks_are_in_the_frame_of_the_base_and_answered_in_that_of_the_map():
    T, T_map_frame = se2.matrix(1.0, 2.0, 0.5), se2.matrix(-3.0, 1.0, 2.0)
    plain, moved = MoverTracker(2), MoverTracker(2)
    path = walk((3.0, -1.0), (0.0, 1.0))
    (here,) = follow(plain, [path], 1.5)
    follow(moved, [path], 1.5, T=T)
    (there,) = moved.movers(T_map_frame)
    M = T_map_frame @ T
    np.testing.assert_allclose(there.position, M[:2, :2] @ here.position + M[:2, 2], atol=1e-4)
    np.testing.assert_allclose(there.velocity, M[:2, :2] @ here.velocity, atol=1e-4)
    plain.move(M)
    np.testing.assert_allclose(plain.movers(np.eye(3))[0].position, there.position, atol=1e-4)
    plain.clear()
    assert not plain.movers(np.eye(3))


def test_movers_in_a_corridor_are_its_walkers(corridor):
    """Of those that have been in sight for a second within 10 m, and of what is taken for one."""
    truth, recording = corridor.truth, corridor.recording
    seconds = 1e-9 * (recording.stamp_ns - recording.stamp_ns[0])
    T_map_world = se2.inverse(truth.T_world_base[0])
    true = truth.movers[..., :2] @ T_map_world[:2, :2].T + T_map_world[:2, 2]
    speeds = np.linalg.norm(np.gradient(true, seconds, axis=0), axis=2)
    since = np.full(true.shape[1], np.inf)
    seen, found, right, errors = 0, 0, 0, []
    for t, update in enumerate(corridor.updates):
        count = np.bincount(
            truth.mover[recording.beams_of(t)].clip(-1) + 1, minlength=len(since) + 1
        )
        since = np.where(count[1:] > 0, np.minimum(since, seconds[t]), np.inf)
        near = np.linalg.norm(true[t] - update.pose[:2, 2], axis=1) < 10.0
        walkers = np.flatnonzero((seconds[t] - since > 1.0) & near & (speeds[t] > 0.3))
        at = np.array([m.position for m in update.movers]).reshape(-1, 2)
        distance = np.linalg.norm(true[t][:, None] - at, axis=2)
        right += int((distance < 0.5).any(axis=0).sum())
        seen += len(walkers)
        for k in walkers[(distance[walkers] < 0.5).any(axis=1)]:
            found += 1
            mover = update.movers[distance[k].argmin()]
            errors.append(abs(np.linalg.norm(mover.velocity) - speeds[t, k]))
    assert seen > 300
    assert found > 0.7 * seen  # who is there from the start is static until then
    assert right > 0.85 * sum(len(update.movers) for update in corridor.updates)
    assert np.median(errors) < 0.15
