"""The node seen in Foxglove while it maps."""

import re
import signal
import time

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here: make test-ros makes an environment with it")
pytest.importorskip("foxglove", reason="foxglove-sdk is not here: make test-ros installs it")
pytest.importorskip("websockets", reason="the client is not here: make test-ros installs it")

from foxglove_client import Client, pose_of, stamp_of

import stillmap

URL = re.compile(r"ws://127\.0\.0\.1:\d+")


def test_the_node_seen_live(simulation, tf_environment, start_node, start_robot, tmp_path):
    node = start_node(tf_environment, more=("--foxglove", "--port", "0"))
    deadline = time.monotonic() + 60.0
    while not URL.search(node.text):
        assert node.is_running, node.text
        assert time.monotonic() < deadline
        time.sleep(0.1)
    with Client(URL.search(node.text)[0]) as client:
        client.subscribe("/map", "/pose", "/tf", "/movers", "/path", "/scan_static")
        robot, sent = start_robot("--tf")
        last = int(simulation.recording.stamp_ns[-1])
        client.wait(lambda client: client.times[-1:] == [last], 120.0)
        node.send(signal.SIGINT)
        client.read_all()
    assert robot.wait() == 0
    assert node.wait() == 0, node.text
    result = stillmap.load(tmp_path / "result")
    assert len(result.poses) == len(sent()) == 400
    assert client.received.keys() == {"/map", "/pose", "/tf", "/movers", "/path", "/scan_static"}
    given = np.loadtxt(tmp_path / "result/live/trajectory.tum")
    at = {round(1e3 * row[0]): row[1:3] for row in given}
    for pose in client.received["/pose"]:
        expected = at[round(1e-6 * stamp_of(pose))]
        np.testing.assert_allclose(pose_of(pose["pose"])[:2, 3], expected, atol=1e-5)
    assert len(client.received["/pose"]) > 50
