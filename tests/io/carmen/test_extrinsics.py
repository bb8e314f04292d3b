"""Upside-down lasers, other fields of view, and second lasers."""

import math

import numpy as np
import pytest

from stillmap.core import se2
from stillmap.core.errors import InputError

HEADER = "0 -1.0 2.0 0.5 20.0 0.01 0"  # five beams, half a radian apart
RAW = f"{HEADER} 5 1 2 3 4 5 0"


def angles(recording, scan=0):
    x, y = recording.points[recording.beams_of(scan)].T
    return np.arctan2(y, x)


def mirrored(recording):
    return recording.points * np.array([1, -1], np.float32)


@pytest.mark.parametrize(("place", "kind"), [("front", "FLASER"), ("rear", "RLASER")])
def test_upside_down_by_params(read_log, flaser, place, kind):
    line = flaser(1.0, kind=kind)
    upright = read_log([line])
    assert not upright.source.sensors[0].upside_down
    for value, flips in (("1", True), ("0", False)):
        recording = read_log([f"PARAM robot_{place}laser_flipped {value} host 0", line])
        expected = mirrored(upright) if flips else upright.points
        np.testing.assert_allclose(recording.points, expected, atol=1e-6)
        np.testing.assert_allclose(recording.T_base_sensor, upright.T_base_sensor)
        noted = recording.source.sensors[0]
        assert (noted.upside_down, noted.upside_down_how) == (flips, "PARAM")
    assert np.abs(upright.points[:, 1]).max() > 0.5


def test_readings_reversed_by_the_driver(read_log, flaser):
    # laser_..._flipped: CARMEN's laser server has already reversed the readings
    lines = [flaser(1.0)]
    plain = read_log(lines)
    turned = read_log(["PARAM laser_front_laser_flipped 1", "PARAM laser_laser1_flipped 1", *lines])
    np.testing.assert_array_equal(turned.points, plain.points)


def test_options_override_params(read_log, flaser):
    lines = ["PARAM robot_frontlaser_flipped 1", flaser(1.0)]
    recording = read_log(lines, laser_upside_down=False)
    np.testing.assert_array_equal(recording.points, read_log(lines[1:]).points)
    assert recording.source.sensors[0].upside_down_how == "given"
    recording = read_log(lines[1:], laser_upside_down=True)
    np.testing.assert_allclose(recording.points, mirrored(read_log(lines[1:])), atol=1e-6)


@pytest.mark.parametrize("line", [f"RAWLASER1 {RAW} 1.0 h 1", f"ROBOTLASER1 {RAW} 0 0 0 0 0 0 "
                                  "0 0 0 0 0 1.0 h 1"])  # fmt: skip
def test_upside_down_with_declared_angles(read_log, line):
    upright, hanging = read_log([line]), read_log([line], laser_upside_down=True)
    np.testing.assert_allclose(angles(upright), [-1, -0.5, 0, 0.5, 1], atol=1e-6)
    np.testing.assert_allclose(angles(hanging), [1, 0.5, 0, -0.5, -1], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(hanging.points, axis=1), [1, 2, 3, 4, 5], rtol=1e-6)


@pytest.mark.parametrize(("n", "fov", "last", "step"), [
    (91, 90, 45, 1), (90, 90, 44, 1), (541, 270, 135, 0.5), (1081, 270, 135, 0.25),
    (720, 360, 179.5, 0.5), (361, 360, 180, 1),
])  # fmt: skip
def test_fields_of_view(read_log, flaser, n, fov, last, step):
    line = flaser(1.0, [2.0] * n)
    given = read_log([line], laser_fov=math.radians(fov))
    stated = read_log([f"PARAM laser_front_laser_fov {fov}.0 host 0", line])
    for recording in (given, stated):
        found = np.degrees(np.unwrap(angles(recording)))
        np.testing.assert_allclose(found, -fov / 2 + step * np.arange(n), atol=1e-3)
        assert found[-1] == pytest.approx(last, abs=1e-3)
    noted = given.source.sensors[0]
    assert math.degrees(noted.angle_step) == pytest.approx(step)


def test_the_second_laser(read_log, flaser):
    lines = [flaser(1.0), flaser(1.1, kind="RLASER"), "PARAM robot_rearlaser_offset -0.3"]
    options = {"laser2_y": 0.1, "laser2_theta": 3.0, "laser2_upside_down": True}
    plain, recording = read_log(lines), read_log(lines, **options, laser2_fov=1.0)
    x = se2.parameters(recording.T_base_sensor)
    np.testing.assert_allclose(x, [[0, 0, 0], [-0.3, 0.1, 3.0]], atol=1e-12)
    np.testing.assert_array_equal(angles(recording, 0), angles(plain, 0))
    np.testing.assert_allclose(angles(recording, 1), [0.5, 0.25, 0, -0.25], atol=1e-6)
    assert [s.upside_down for s in recording.source.sensors] == [False, True]
    with pytest.raises(InputError, match="laser2_"):
        read_log(lines[:1], **options)
