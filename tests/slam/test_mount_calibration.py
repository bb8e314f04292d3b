"""Mounts and odometry errors in a simulated office, which the recording does not tell."""

import dataclasses
import functools
import math

import numpy as np
import pytest
from driven import picked

from stillmap.core import se2
from stillmap.core.recording import Recording
from stillmap.prepare.lasers import mirror_beams
from stillmap.sim import scene_by_name, simulate
from stillmap.slam.hand_eye import correct_odometry
from stillmap.slam.mount_calibration import Calibration, calibrate_mounts

RESOLUTION = 0.05
LASER = (0.08, 0.0, 0.0)  # of the simulator


@functools.cache
def office(yaw: float = 0.0, second_laser: bool = False) -> Recording:
    laser = {"yaw": yaw, "second_laser": second_laser}
    scene = scene_by_name("office", {"laser": laser, "robot": {"scans": 400}})
    return simulate(scene, 3).recording


def recorded_as(recording, x, y, theta):
    return dataclasses.replace(recording, T_base_sensor=se2.matrix([x], [y], [theta]))


def with_odometry(**errors):
    recording = office()
    seconds = 1e-9 * (recording.stamp_ns - recording.stamp_ns[0])
    no_errors = {"scale": 1.0, "rotation_gain": 1.0, "latency": 0.0}
    odometry = correct_odometry(seconds, recording.T_odom_base, **{**no_errors, **errors})
    return dataclasses.replace(recording, T_odom_base=odometry)


def significant(found: Calibration) -> set[str]:
    named = [item for one in (*found.lasers, found.odometry) for item in one.items()]
    flipped = {"upside_down"} if any(found.upside_down) else set()
    return flipped | {name for name, one in named if one.significant}


def test_nothing_is_wrong():
    found = calibrate_mounts(office(), RESOLUTION)
    assert significant(found) == set()
    assert 20 <= found.windows < 60
    laser = found.lasers[0]
    for name, true in zip(("x", "y", "theta"), LASER, strict=True):
        assert abs(laser[name].value - true) < 4 * laser[name].std < 0.1


@pytest.mark.parametrize(
    ("yaw", "recorded", "names", "true"),
    [
        (math.pi, LASER, {"theta"}, math.pi),  # it faces backwards
        (0.0, (0.08, -0.3, 0.0), {"x", "y"}, 0.0),
        (0.0, (0.08, 0.0, math.radians(10)), {"theta"}, 0.0),
    ],
)
def test_a_laser_that_sits_elsewhere(yaw, recorded, names, true):
    found = calibrate_mounts(recorded_as(office(yaw), *recorded), RESOLUTION)
    assert significant(found) == names
    laser = found.lasers[0]
    assert abs(se2.wrap(laser["theta"].value - true)) < 0.02
    if "y" in names:
        assert laser["y"].value == pytest.approx(0.0, abs=0.02)


def test_what_is_told_stays():
    recording = recorded_as(office(), 0.08, 0.0, math.radians(10))
    found = calibrate_mounts(recording, RESOLUTION, [("theta", "x", "y", "upside_down")])
    assert found.lasers == [{}]
    assert "theta" not in significant(found)
    mirrored = mirror_beams(office(), 0)
    assert significant(calibrate_mounts(mirrored, RESOLUTION)) == {"upside_down"}
    assert not calibrate_mounts(mirrored, RESOLUTION, [("upside_down",)]).upside_down[0]


@pytest.mark.parametrize(
    ("errors", "name", "value"),
    [
        ({"scale": 1 / 1.1}, "scale", 1.1),
        ({"rotation_gain": 1 / 0.85}, "rotation_gain", 0.85),
        ({"latency": -0.2}, "latency", 0.2),
    ],
)
def test_odometry(errors, name, value):
    found = calibrate_mounts(with_odometry(**errors), RESOLUTION)
    assert significant(found) == {name}
    assert found.odometry[name].value == pytest.approx(value, abs=0.03)


@pytest.mark.parametrize("latency", [2.0, -1.5])
def test_latency_of_slow_scans(latency):
    recording = with_odometry(latency=-latency)
    slow = picked(recording, np.arange(0, recording.n_scans, 8))  # 1.6 s
    found = calibrate_mounts(slow, RESOLUTION).odometry["latency"]
    assert found.significant
    assert found.value == pytest.approx(latency, abs=0.1)


def test_the_second_of_two_lasers():
    recording = office(0.0, True)
    T = np.array(recording.T_base_sensor)
    T[1] = T[1] @ se2.matrix(0.0, 0.0, 1.0)
    found = calibrate_mounts(dataclasses.replace(recording, T_base_sensor=T), RESOLUTION)
    assert not any(one.significant for one in found.lasers[0].values())
    assert found.lasers[1]["theta"].significant
    assert abs(se2.wrap(found.lasers[1]["theta"].value - math.pi)) < 0.03


def test_no_odometry_and_no_motion():
    assert calibrate_mounts(office().without_odometry(), RESOLUTION) == Calibration()
    still = np.tile(np.eye(3), (office().n_scans, 1, 1))
    found = calibrate_mounts(dataclasses.replace(office(), T_odom_base=still), RESOLUTION)
    assert (found.lasers, found.windows) == ([], 0)
