"""The node with other sensors: without odometry, with two lasers, with a lidar."""

import signal

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here: make test-ros makes an environment with it")
pytest.importorskip("cyclonedds", reason="the judge is not here: make test-ros installs it")

import ros_idl as idl
from dds import wait_for
from judge import poses_of, stamp_of, truth_at

import stillmap
from stillmap.core import se2
from stillmap.results.eval.trajectory import compute_absolute_errors


def test_a_robot_without_odometry_is_mapped_too(
    simulation, judge, tf_environment, start_node, start_robot
):
    node = start_node(tf_environment, 'odom_frame:=""')
    start_robot("--tf", "--last", "150")
    assert wait_for(lambda: len(judge.poses) == 150, 60.0), node.text
    stamps = [stamp_of(one) for one in judge.poses]
    errors = compute_absolute_errors(poses_of(judge.poses), truth_at(simulation, stamps))
    assert errors.rmse < 0.1
    ours = [t for one in judge.tf for t in one.message.transforms if t.header.frame_id == "map"]
    assert {one.child_frame_id for one in ours} == {"base_footprint"}


def test_two_lasers(simulation, judge, participant, tf_environment, start_node, start_robot):
    of_each = [
        participant.read(idl.LaserScan, f"{topic}_static", reliable=True)
        for topic in ("scan_right", "scan_left")
    ]
    start_node(tf_environment, 'scan_topic:=["scan_right", "scan_left"]')
    # 20 of each in a second: who maps more than comes is not what is tested
    start_robot("--tf", "--split", "--last", "150", "--period", "0.05")
    assert wait_for(lambda: len(judge.poses) == 300, 60.0), str((len(judge.poses), judge.values))
    stamps = [stamp_of(one) for one in judge.poses]
    assert stamps == sorted(stamps)
    errors = compute_absolute_errors(poses_of(judge.poses), truth_at(simulation, stamps))
    assert errors.rmse < 0.05
    assert wait_for(lambda: all(len(scans) == 150 for scans in of_each))
    assert {one.message.angle_min < -1.5 for one in of_each[0]} == {True}
    assert {one.message.angle_min > -0.1 for one in of_each[1]} == {True}


def test_sweeps_of_a_lidar(
    sweeps, judge, participant, tf_environment, start_node, start_robot, tmp_path
):
    simulation, path = sweeps
    clouds = {
        name: participant.read(idl.PointCloud2, f"points_{name}", reliable=True)
        for name in ("static", "dynamic", "points")
    }
    node = start_node(tf_environment, "cloud_topic:=points", "map_update_interval:=1.0")
    robot, _ = start_robot("--tf", "--period", "0.2", recording=path)
    assert wait_for(lambda: len(judge.poses) == 60, 90.0), node.text + robot.text
    stamps = [stamp_of(one) for one in judge.poses]
    T = truth_at(simulation, stamps)
    true = (se2.inverse(T[0]) @ T)[:, :3, 3]
    poses = [one.message.pose.pose for one in judge.poses]
    found = np.array([[p.position.x, p.position.y, p.position.z] for p in poses])
    assert np.linalg.norm(found - true, axis=1).max() < 0.5
    assert wait_for(lambda: all(len(one) == 60 for one in clouds.values()))
    for static, dynamic, every in zip(*clouds.values(), strict=True):
        widths = [one.message.width for one in (static, dynamic, every)]
        assert widths[0] + widths[1] == widths[2] > 1000
        assert every.message.header.frame_id == "laser"
    assert wait_for(lambda: judge.maps)
    assert 100 in judge.maps[-1].message.data
    node.send(signal.SIGINT)
    assert node.wait() == 0, node.text
    assert len(stillmap.load(tmp_path / "result").poses) == 60
