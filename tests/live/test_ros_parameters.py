"""Parameters of the node, and what `stillmap live` says where there is no ROS."""

import importlib.util

import pytest

from stillmap.cli.main import main
from stillmap.core.errors import InputError
from stillmap.live.ros.parameters import Parameters, declare


def read(defaults=None, **given):
    return declare(lambda name, default, _: given.get(name, default), **defaults or {})


def test_what_is_declared_is_what_is_read():
    assert read() == Parameters()
    assert read(defaults={"resolution": 0.1}).resolution == 0.1
    assert read(defaults={"resolution": 0.1}, resolution=0.2).resolution == 0.2


def test_one_topic_or_several():
    assert read(scan_topic="/scan").scan_topic == ("/scan",)
    found = read(scan_topic=["front", "rear"], laser_pose=[0, 0, 0, 1, 0, 3.14])
    assert found.scan_topic == ("front", "rear")
    assert found.laser_pose == (0.0, 0.0, 0.0, 1.0, 0.0, 3.14)


def test_a_whole_number_is_a_number():
    assert read(map_update_interval=2).map_update_interval == 2.0


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
    assert "rclpy is not in this environment" in line
    assert "source /opt/ros/" in line
    assert line.count("\n") == 1
