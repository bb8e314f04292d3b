"""Parameters of the node, messages and arrays, without ROS; what is said where there is none."""

import importlib.util
import math

import numpy as np
import pytest
from ros_messages import laser_scan

from stillmap.cli.main import main
from stillmap.core.errors import InputError
from stillmap.live.ros import inputs as messages
from stillmap.live.ros.inputs import Mount, Parameters, declare


def read(defaults=None, **given):
    return declare(lambda name, default, _: given.get(name, default), **defaults or {})


def test_what_is_declared_is_what_is_read():
    assert read() == Parameters()
    assert read(defaults={"resolution": 0.1}).resolution == 0.1
    assert read(defaults={"resolution": 0.1}, resolution=0.2).resolution == 0.2


def test_one_topic_or_several_and_whole_numbers():
    assert read(scan_topic="/scan").scan_topic == ("/scan",)
    given = read(scan_topic=["front", "rear"], laser_pose=[0, 0, 0, 1, 0, 3.14])
    assert given.scan_topic == ("front", "rear")
    assert given.laser_pose == (0.0, 0.0, 0.0, 1.0, 0.0, 3.14)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"resolution": 0.0}, "parameters: 'resolution' must be more than 0, got 0.0"),
        ({"resolution": "fine"}, "resolution"),
        ({"transform_timeout": -1.0}, "transform_timeout"),
        ({"throttle_scans": 0}, "throttle_scans"),
        ({"throttle_scans": 1.5}, "throttle_scans"),
        ({"map_frame": ""}, "map_frame"),
        ({"scan_topic": []}, "scan_topic"),
        ({"scan_topic": [1]}, "scan_topic"),
        ({"laser_pose": [1.0]}, "'laser_pose' must be 3 numbers"),
        ({"cloud_topic": [2.0]}, "cloud_topic"),
        (
            {"cloud_topic": "points", "laser_pose": [1.0, 0.0, 0.0]},
            "'laser_pose' must be 6 numbers",
        ),
    ],
)
def test_wrong_values_are_named(given, says):
    with pytest.raises(InputError) as error:
        read(**given)
    assert says in str(error.value)


@pytest.mark.skipif(importlib.util.find_spec("rclpy") is not None, reason="ROS 2 is here")
def test_without_ros_one_line_says_how_to_get_it(tmp_path, capsys):
    arguments = ["live", "-o", str(tmp_path / "out"), "--ros-args", "--params-file", "my.yaml"]
    assert main(arguments) == 2
    line = capsys.readouterr().err
    assert "No module named 'rclpy'" in line
    assert "source /opt/ros/" in line
    assert line.count("\n") == 1


LEVEL = Mount(np.eye(3))
INF, NAN = math.inf, math.nan


def test_readings_become_beams_in_their_order():
    message = laser_scan(5_000_000_007, [2.0, INF, 25.0, NAN, 0.05, 1.0])
    beams = messages.to_scan_beams(message, "scan", LEVEL, Parameters())
    assert beams.stamp_ns == 5_000_000_007
    assert beams.sensor == "scan"
    np.testing.assert_array_equal(beams.hit, [True, False, False, False, False, True])
    length = np.linalg.norm(beams.points, axis=1)
    np.testing.assert_allclose(length, [2.0, 20.0, 20.0, NAN, NAN, 1.0], rtol=1e-6)
    np.testing.assert_allclose(np.arctan2(*beams.points[5, ::-1]), -0.5, rtol=1e-6)
    assert beams.beam_time is None


def test_limits_of_the_parameters():
    message = laser_scan(1, [0.3, 8.0, 3.0])
    limits = Parameters(min_laser_range=0.5, max_laser_range=5.0)
    beams = messages.to_scan_beams(message, "scan", LEVEL, limits)
    np.testing.assert_array_equal(beams.hit, [False, False, True])
    length = np.linalg.norm(beams.points, axis=1)
    np.testing.assert_allclose(length, [NAN, 5.0, 3.0], rtol=1e-6)


@pytest.mark.parametrize(
    ("increment", "times"), [(0.01, [0.0, 0.01, 0.02]), (0.0, None), (1.0, None), (-0.1, None)]
)
def test_times_of_beams(increment, times):
    message = laser_scan(1, [1.0, 1.0, 1.0], time_increment=increment)
    found = messages.to_scan_beams(message, "scan", LEVEL, Parameters()).beam_time
    if times is None:
        assert found is None
    else:
        np.testing.assert_allclose(found, times)


def test_cells_as_nav2_reads_them():
    p = np.array([[0.0, 0.19, 0.3], [0.66, 1.0, NAN]], np.float32)
    np.testing.assert_array_equal(messages.to_cells(p, "trinary"), [[0, 0, -1], [100, 100, -1]])
    np.testing.assert_array_equal(messages.to_cells(p, "raw"), [[0, 19, 30], [66, 100, -1]])
