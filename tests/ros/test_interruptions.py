"""Messages that are lost or odd, robots and nodes that die, clocks that are set back, saving."""

import signal
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here: make test-ros makes an environment with it")
pytest.importorskip("cyclonedds", reason="the judge is not here: make test-ros installs it")

from dds import wait_for
from judge import laser_pose, poses_of, stamp_of, truth_at

import stillmap
from stillmap.core import se2
from stillmap.results.eval.trajectory import compute_absolute_errors


def test_lost_swapped_and_odd_stamps_and_a_robot_that_dies(
    simulation, judge, tf_environment, start_node, start_robot, tmp_path
):
    """Odometry from its topic."""
    node = start_node(tf_environment, laser_pose(simulation.recording), "use_sim_time:=true")
    robot, sent = start_robot(
        *("--lose", "0.02", "--swap", "0.02", "--jump", "50", "--jump", "51", "--leap", "90")
    )
    assert wait_for(lambda: len(judge.poses) > 150, 60.0), node.text + robot.text
    robot.kill()
    lines = sent()
    # what came late, and what nobody can believe
    kept, last = [], 0
    for line in lines:
        is_odd = line["scan"] in (50, 51, 90)
        if line["stamp_ns"] > last and not is_odd:
            kept.append(line["stamp_ns"])
            last = line["stamp_ns"]
    assert wait_for(lambda: len(judge.poses) >= len(kept) - 2)
    stamps = [stamp_of(one) for one in judge.poses]
    assert len(set(kept) - set(stamps)) <= 2  # on their way when the robot died
    assert stamps == sorted(set(stamps))
    assert wait_for(lambda: "stamp far ahead of the scan before" in judge.values, 5.0)
    assert int(judge.values["stamp before that of an earlier scan"]) >= 2

    # another robot process goes on where the first one died
    before = len(judge.poses)
    first = lines[-1]["scan"] + 10
    robot, sent = start_robot("--first", str(first))
    assert wait_for(lambda: len(judge.poses) == before + 400 - first, 60.0), node.text
    assert node.is_running
    stamps = [stamp_of(one) for one in judge.poses]
    errors = compute_absolute_errors(poses_of(judge.poses), truth_at(simulation, stamps))
    assert errors.rmse < 0.08
    node.send(signal.SIGTERM)
    assert node.wait() == 0, node.text
    assert len(stillmap.load(tmp_path / "result").poses) == len(judge.poses)


def test_a_clock_that_is_set_back_is_told(
    simulation, judge, tf_environment, start_node, start_robot, tmp_path
):
    node = start_node(tf_environment, laser_pose(simulation.recording))
    robot, _ = start_robot("--last", "60", "--shift", "3600")
    assert wait_for(lambda: len(judge.poses) == 60, 60.0), node.text
    assert robot.wait() == 0
    start_robot("--last", "200")
    text = "clock set back by 3"
    assert wait_for(lambda: any(text in status(one) for one in judge.diagnostics), 30.0)
    assert wait_for(lambda: "clock set back" in node.text, 10.0)
    assert node.text.count("clock set back") == 1
    assert len(judge.poses) == 60
    node.send(signal.SIGINT)
    assert node.wait() == 0, node.text
    assert len(stillmap.load(tmp_path / "result").poses) == 60


def status(received):
    return received.message.status[0].message


def test_a_bag_that_is_played_again_begins_a_new_map(
    simulation, judge, tf_environment, start_node, start_robot, tmp_path
):
    node = start_node(tf_environment, "use_sim_time:=true")
    robot, _ = start_robot("--tf", "--first", "60", "--last", "120", "--shift", "3600")
    assert wait_for(lambda: len(judge.poses) == 60, 60.0), node.text
    assert robot.wait() == 0
    start_robot("--tf", "--last", "300", "--period", "0.04")
    assert wait_for(lambda: len(judge.poses) > 100, 60.0), node.text
    received = judge.poses[60:]
    stamps = [stamp_of(one) for one in received]
    origins = truth_at(simulation, stamps) @ se2.inverse(poses_of(received))
    assert np.ptp(origins[:, :2, 2], axis=0).max() < 0.1
    assert "a new map begins" in node.text
    ours = [t for one in judge.tf for t in one.message.transforms if t.header.frame_id == "map"]
    assert ours[-1].header.stamp.sec < ours[0].header.stamp.sec
    node.send(signal.SIGINT)
    assert node.wait() == 0, node.text
    assert len(stillmap.load(tmp_path / "result-before").poses) == 60
    assert 40 < len(stillmap.load(tmp_path / "result").poses) < 300


def test_a_node_that_is_killed_can_be_started_again(
    simulation, judge, tf_environment, start_node, start_robot
):
    first = start_node(tf_environment, laser_pose(simulation.recording))
    robot, _ = start_robot("--period", "0.05")
    assert wait_for(lambda: len(judge.poses) > 50, 60.0), first.text + robot.text
    first.kill()
    before, maps = len(judge.poses), len(judge.maps)
    second = start_node(tf_environment, laser_pose(simulation.recording))
    assert wait_for(lambda: len(judge.poses) > before + 30, 60.0), second.text
    # it begins anew: its map has the frame of its own first scan, on the robot's way
    received = judge.poses[before:]
    T_world_base = truth_at(simulation, [stamp_of(one) for one in received])
    origins = T_world_base @ se2.inverse(poses_of(received))
    assert np.ptp(origins[:, :2, 2], axis=0).max() < 0.1
    way = simulation.truth.T_world_base[:, :2, 2]
    distance = np.linalg.norm(way - origins[0, :2, 2], axis=1)
    assert distance.min() < 0.05
    assert distance[:50].min() > 0.1
    assert wait_for(lambda: len(judge.maps) > maps)
    assert robot.is_running


def test_the_map_is_saved_on_demand_while_mapping_goes_on(
    simulation, judge, tf_environment, start_node, start_robot, tmp_path
):
    node = start_node(tf_environment, laser_pose(simulation.recording))
    start_robot()
    assert wait_for(lambda: len(judge.poses) > 100, 60.0), node.text
    answer = subprocess.run(
        [sys.executable, "-c", CALL], env=tf_environment, capture_output=True, text=True, timeout=60
    )
    assert answer.stdout.startswith("True wrote"), answer.stdout + answer.stderr + node.text
    saved = len(stillmap.load(tmp_path / "result").poses)
    assert 100 < saved <= 400
    assert wait_for(lambda: len(judge.poses) == 400, 60.0), "mapping did not go on"
    node.send(signal.SIGINT)
    assert node.wait() == 0, node.text
    assert len(stillmap.load(tmp_path / "result").poses) == 400


CALL = """
import rclpy
from std_srvs.srv import Trigger
rclpy.init()
node = rclpy.create_node("caller")
client = node.create_client(Trigger, "/stillmap/save_map")
assert client.wait_for_service(20.0)
future = client.call_async(Trigger.Request())
rclpy.spin_until_future_complete(node, future, timeout_sec=40.0)
print(future.result().success, future.result().message)
"""
