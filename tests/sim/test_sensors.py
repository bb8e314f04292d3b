"""Lasers that hang upside down, and a second one that looks backwards."""

import numpy as np
import pytest

from stillmap import io
from stillmap.core import se2
from stillmap.sim import scene_by_name, simulate


def taken(beams=61, scans=60, name="hall", **laser):
    exact = {"range_noise": 0.0, "no_return_share": 0.0, "glass_no_return_share": 0.0}
    changes = {"robot": {"scans": scans}, "laser": {"beams": beams, **exact, **laser}}
    return simulate(scene_by_name(name, changes), 6)


def ranges_of(simulation):
    T = simulation.recording.n_scans
    return np.hypot(*simulation.recording.points.T).reshape(T, -1).astype(float)


@pytest.mark.parametrize("upside_down", ["known", "unknown"])
def test_an_upside_down_laser_gives_its_beams_from_left_to_right(upside_down):
    upright, turned = taken(), taken(upside_down=upside_down)
    np.testing.assert_allclose(ranges_of(turned), ranges_of(upright)[:, ::-1], atol=1e-5)
    movers = turned.truth.mover.reshape(60, -1)
    np.testing.assert_array_equal(movers, upright.truth.mover.reshape(60, -1)[:, ::-1])
    assert (movers >= 0).any()
    if upside_down == "known":  # whoever knows it sees the same place
        points = turned.recording.points.reshape(60, -1, 2)[:, ::-1]
        np.testing.assert_allclose(points, upright.recording.points.reshape(60, -1, 2), atol=1e-5)
        (sensor,) = turned.recording.source.sensors
        found = sensor.start_angle, sensor.angle_step
        assert found == pytest.approx((np.pi / 2, -np.pi / 60))


@pytest.mark.parametrize("sweep_time", [0.0, 0.2])
def test_a_second_laser_looks_backwards_by_turns(sweep_time):
    run = taken(second_laser=True, sweep_time=sweep_time, scans=100)
    r = run.recording
    np.testing.assert_array_equal(r.sensor, np.arange(100) % 2)
    np.testing.assert_allclose(np.diff(r.stamp_ns), 10**8)
    place = se2.parameters(r.T_base_sensor)
    np.testing.assert_allclose(place[:, :2], [[0.08, 0], [-0.08, 0]], atol=1e-12)
    np.testing.assert_allclose(np.abs(place[:, 2]), [0, np.pi])
    assert [s.name for s in r.source.sensors] == ["simulated laser", "simulated rear laser"]


def test_hits_of_both_lasers_lie_on_the_walls(wall_distance, end_points):
    run = taken(second_laser=True, scans=200)
    xy, scan = end_points(run)
    static = run.truth.static
    assert wall_distance(xy[static], run.truth.walls).max() < 1e-4
    both = [static[run.recording.sensor[scan] == k].sum() for k in (0, 1)]
    assert min(both) > 3000
    mover = run.truth.mover
    hit = np.flatnonzero(mover >= 0)
    off = np.hypot(*(xy[hit] - run.truth.movers[scan[hit], mover[hit], :2]).T)
    assert off.max() < 0.48
    assert set(run.recording.sensor[scan[hit]]) == {0, 1}


def test_two_lasers_survive_as_a_carmen_log(tmp_path):
    run = taken(60, second_laser=True)
    io.write(run.recording, tmp_path / "sim.log")
    log, own = io.read(tmp_path / "sim.log"), run.recording
    np.testing.assert_array_equal(log.sensor, own.sensor)
    np.testing.assert_array_equal(log.stamp_ns, own.stamp_ns)
    np.testing.assert_allclose(log.points[log.hit], own.points[own.hit], atol=0.0051)
    np.testing.assert_allclose(log.T_base_sensor, own.T_base_sensor, atol=2e-5)
