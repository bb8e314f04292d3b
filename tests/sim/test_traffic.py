"""Vehicles: they keep to their lanes and their distance, stop, and wait for their turn."""

import numpy as np
import pytest

from stillmap.sim.options import TrafficOptions
from stillmap.sim.scene import Lane, Light
from stillmap.sim.vehicles import Traffic

FAR = np.array([0.0, 1000.0])
STRAIGHT = Lane(((0.0, 0.0), (300.0, 0.0)))
RING = Lane(tuple((30 * np.cos(a), 30 * np.sin(a)) for a in np.linspace(0, 2 * np.pi, 200)[:-1]))
RING = Lane((*RING.path, RING.path[0]))


def driven(traffic, steps, robot=FAR):
    poses = []
    for _ in range(steps):
        poses.append(traffic.poses())
        traffic.step(0.1, robot, 0.9)
    return np.array(poses)


def traffic(lane, seed=0, **options):
    return Traffic((lane,), TrafficOptions(**options), np.random.default_rng(seed))


@pytest.mark.parametrize("seed", range(4))
def test_on_one_lane_nobody_touches(seed):
    busy = traffic(RING, seed, vehicles=10, stopping_share=0.5, min_speed=3.0, max_speed=12.0)
    poses = driven(busy, 2000)
    gap = np.hypot(*np.moveaxis(poses[:, :, None, :2] - poses[:, None, :, :2], -1, 0))
    gap[:, *np.diag_indices(10)] = np.inf
    assert gap.min() > 4.4 * 0.94
    step = np.hypot(*np.moveaxis(np.diff(poses[..., :2], axis=0), -1, 0))
    assert step.max() < 1.2 + 1e-9
    assert (step < 1e-9).any()
    assert step.sum(axis=0).min() > 100.0
    radius = np.hypot(poses[..., 0], poses[..., 1])
    np.testing.assert_allclose(radius, 30.0, atol=0.15)
    # it faces the way it goes
    tangent = np.arctan2(poses[..., 1], poses[..., 0]) + np.pi / 2
    off = (poses[..., 2] - tangent + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(off).max() < 0.05


def test_it_brakes_for_the_robot_on_its_lane():
    one = traffic(STRAIGHT, 1, vehicles=1, stopping_share=0.0)
    robot = np.array([250.0, 0.3])
    poses = driven(one, 600, robot)[:, 0]
    front = poses[:, 0] + one.size[0, 0] / 2
    assert front.max() < 250.0 - 0.9
    assert front[-1] > 250.0 - 0.9 - 2.5
    assert poses[-1, 0] == poses[-50, 0]
    beside = driven(one, 50, np.array([250.0, 4.0]))
    assert beside[-1, 0, 0] > 255.0


def test_a_queue_waits_for_the_robot_and_then_drives_off_one_by_one():
    lane = Lane(STRAIGHT.path, waiting=4, stop=100.0, go=(60.0, 50.0))
    queue = traffic(lane, vehicles=7, stopping_share=0.0)
    assert queue.kinds == ["car"] * 4
    waiting = driven(queue, 300)
    np.testing.assert_array_equal(waiting, waiting[:1].repeat(300, axis=0))
    front = waiting[0, :, 0] + queue.size[:, 0] / 2
    rear = waiting[0, :, 0] - queue.size[:, 0] / 2
    assert front[0] == pytest.approx(99.0)  # half the gap before the line
    np.testing.assert_allclose(rear[:-1] - front[1:], 2.0)
    driven(queue, 1, np.array([58.0, 49.0]))
    going = driven(queue, 100)
    begins = np.argmax(going[:, :, 0] > going[0, :, 0] + 0.1, axis=0)
    assert np.all(np.diff(begins) > 0)
    assert going[-1, -1, 0] > 110.0


def test_it_stops_at_a_red_light_and_goes_on_when_it_is_green():
    lane = Lane(STRAIGHT.path, lights=(Light((150.0, 0.0), (0.0, 40.0), 200.0),))
    two = traffic(lane, 1, vehicles=2, stopping_share=0.0, min_speed=9.0, max_speed=9.0)
    poses = driven(two, 600)[..., 0]
    rear, ahead = np.argsort(poses[0])
    if poses[0, ahead] > 145:  # the one that is past the light already comes round to it last
        rear, ahead = ahead, rear
    front = poses[:, ahead] + two.size[ahead, 0] / 2
    red = slice(250, 400)
    np.testing.assert_allclose(front[red], front[300], atol=0.2)
    assert 150.0 - 3.0 < front[300] < 150.0
    assert front[401:600].max() > 200.0


def test_whoever_cuts_in_is_not_run_over():
    one = traffic(STRAIGHT, 1, vehicles=1, stopping_share=0.0, min_speed=12.0, max_speed=12.0)
    start = driven(one, 5)[-1, 0, 0]
    robot = np.array([start + 12.0, 0.0])  # too near to stop at any braking
    front = driven(one, 100, robot)[:, 0, 0] + one.size[0, 0] / 2
    assert front.max() < robot[0] - 0.9
