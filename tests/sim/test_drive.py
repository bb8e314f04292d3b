"""The drive through a town: a car that accelerates, waits at a light and slows down to turn."""

import numpy as np
import pytest

from stillmap.sim.options import RobotOptions
from stillmap.sim.scene import Light
from stillmap.sim.vehicles import SpeedProfile

STRAIGHT = np.stack([np.arange(0, 300.01, 0.05), np.zeros(6001)], axis=-1)
CAR = RobotOptions(speed=15.0, acceleration=2.5)


def driven(pace, steps, dt, way=STRAIGHT):
    """(steps, 2) metres along the way and speed, from a standing start."""
    at, now, out = 0.0, 0.0, []
    for k in range(steps):
        nearest = min(round(at / 0.05), len(way) - 1)
        allowed = pace.limit_speed(nearest, at - 0.05 * nearest, now, k * dt, dt)
        now = pace.accelerate(allowed, now, dt)
        at += now * dt
        out.append((at, now))
    return np.array(out)


@pytest.mark.parametrize("dt", [1 / 75, 0.1])
def test_it_gains_speed_and_stops_at_a_red_light(dt):
    light = Light((200.0, 0.0), (2.0, 40.0), 100.0)
    at, speed = driven(SpeedProfile(STRAIGHT, False, CAR, (light,)), round(60 / dt), dt).T
    gains = round(5.5 / dt)
    np.testing.assert_allclose(speed[:gains], 2.5 * dt * np.arange(1, gains + 1))
    assert speed.max() == pytest.approx(15.0)
    red = slice(round(30 / dt), round(39.9 / dt))
    np.testing.assert_allclose(at[red], 200.0, atol=0.2)
    assert speed[round(41 / dt)] > 2.0
    braking = np.diff(speed[: round(39 / dt)]) / dt
    assert braking.min() > -2.5 * 1.6


def test_whoever_cannot_stop_any_more_drives_on():
    # at 15 m/s it takes 45 m to stop: 30 m before the line it turns red
    reaches = 15.0**2 / (2 * 2.5) + 15.0 * 8.0
    light = Light((reaches + 30.0, 0.0), (14.0, 60.0), 100.0)
    speed = driven(SpeedProfile(STRAIGHT, False, CAR, (light,)), 170, 0.1)[:, 1]
    np.testing.assert_allclose(speed[70:], 15.0)


def test_curves_are_taken_slowly_and_braked_for():
    turn = np.linspace(-np.pi / 2, 0, 315)
    arc = np.stack([100 + 10 * np.cos(turn), 10 + 10 * np.sin(turn)], axis=-1)
    lead = STRAIGHT[STRAIGHT[:, 0] < 100]
    way = np.concatenate([lead, arc, [[110.0, 10 + 0.05 * k] for k in range(1, 2000)]])
    at, speed = driven(SpeedProfile(way, False, CAR, ()), 300, 0.1, way).T
    turning = (at > 101) & (at < 114)
    np.testing.assert_allclose(speed[turning], np.sqrt(2.5 * 10), rtol=0.03)
    assert speed[at < 60].max() == pytest.approx(15.0)
    assert speed[-1] == pytest.approx(15.0)
    # a gentle touch: from point to point of the way, not all at once
    assert np.diff(speed).min() > -0.25 * 1.3


def test_without_an_acceleration_it_drives_at_its_speed_at_once():
    way = np.concatenate([STRAIGHT[:200], STRAIGHT[200] + [[0.0, 0.05 * k] for k in range(200)]])
    pace = SpeedProfile(way, False, RobotOptions(speed=0.5), ())
    assert pace.accelerate(pace.limit_speed(100, 0.0, 0.0, 0.0, 0.1), 0.0, 0.1) == 0.5
    assert {pace.limit_speed(k, 0.0, 0.5, 0.0, 0.1) for k in range(len(way))} == {0.5}


@pytest.mark.parametrize(
    ("red", "times"),
    [((10.0, 30.0), (10, 29.9, 60, 79.9)), ((30.0, 60.0), (0, 9.9, 30))],  # over the end, too
)
def test_a_light_is_red_again_after_a_cycle(red, times):
    light = Light((0.0, 0.0), red, 50.0)
    every = (0, 9.9, 10, 29.9, 30) if red[0] == 30.0 else (0, 9.9, 10, 29.9, 30, 59.9, 60, 79.9, 80)
    assert tuple(t for t in every if light.is_red(t)) == times


@pytest.fixture
def drive(run):
    """The whole route at 10 Hz."""
    return run("drive")


@pytest.mark.slow
def test_it_waits_at_the_light_until_it_is_green(drive):
    xy = drive.truth.T_world_base[:, :2, 2]
    speed = np.hypot(*np.diff(xy, axis=0).T) * 10
    assert 15.5 < speed.max() < 15.6 + 1e-6
    (light,) = drive.scene.lights
    stands = np.flatnonzero(speed < 0.02)[1:]
    assert np.hypot(*(xy[stands[:-1]] - light.at).T).max() < 0.6
    assert light.red[0] < stands[0] / 10 < light.red[1] - 8.0
    assert light.red[1] - 0.2 < stands[-1] / 10 < light.red[1] + 0.5
    assert np.all(np.diff(stands) == 1)


@pytest.mark.slow
def test_cars_do_not_run_red_lights(drive):
    """No car crosses a stop line while it is red, but those too fast to stop."""
    at = drive.truth.movers[..., :2]
    lights = [(lane, light) for lane in drive.scene.lanes for light in lane.lights]
    crossings = 0
    for lane, light in lights:
        along = np.array(lane.path[1]) - lane.path[0]
        along = along / np.hypot(*along)
        ahead, aside = (at - light.at) @ along, (at - light.at) @ [-along[1], along[0]]
        near = (np.abs(aside) < 0.2) & (np.abs(ahead) < 20)
        crosses = near[:-1] & near[1:] & (ahead[:-1] < 0) & (ahead[1:] >= 0)
        late = (np.nonzero(crosses)[0] / 10 - light.red[0]) % light.cycle
        assert np.all((late > light.red[1] - light.red[0]) | (late < 3.0))
        crossings += len(late)
    assert crossings > 3


@pytest.mark.slow
def test_the_queue_at_the_corner_stands_while_it_is_seen(drive):
    truth = drive.truth
    scan = np.repeat(np.arange(drive.recording.n_scans), np.diff(drive.recording.offset))
    for car in range(-drive.scene.lanes[-1].waiting, 0):
        hits = scan[truth.mover == truth.movers.shape[1] + car]
        assert len(hits) > 50
        moved = np.abs(truth.movers[:, car] - truth.movers[0, car]).max(axis=1) > 1e-9
        assert not moved[hits].any()
        assert moved[-1]
