"""What Karto is given and what becomes of its answer; a stand-in takes the package's place."""

import sys

import karto
import numpy as np
import pytest

from stillmap.core import se2
from stillmap.sim import scene_by_name, simulate

# answers with the odometry, ten metres aside, and keeps what it was given
STAND_IN = {
    "__init__": "",
    "helpers": "default_config = {'range_threshold': 20}",
    "scan_matching": """
class Scan2DMatcherCpp:
    def __init__(self, config, loop=False):
        assert config == {}
        self.loop = loop
""",
    "models": """
import math
class Pose:
    def __init__(self, x, y, yaw):
        self.x, self.y, self.euler = x, y, (0, 0, yaw)
class LocalizedRangeScan:
    def __init__(self, ranges, first, last, step, least, most, threshold, x, y, yaw):
        assert math.isclose(first + step * (len(ranges) - 1), last)
        assert threshold == 20
        assert most >= max(r for r in ranges if not math.isnan(r))
        self.corrected_pose = Pose(x, y + 10, yaw)
""",
    "graph_slam": """
import time
class GraphSlam:
    def __init__(self, sequential, loop):
        assert (sequential.loop, loop.loop) == (False, True)
        self.scans = 0
    def process_scan(self, scan):
        end = time.process_time() + 0.002
        while time.process_time() < end:
            pass
        self.scans += 1
        return (None, None) if self.scans == 1 else (scan, self.scans % 2 == 0)
""",
}


@pytest.fixture(scope="module")
def recording():
    laser = {"x": 0.2, "y": -0.1, "yaw": 0.3, "beams": 90}
    scene = scene_by_name("hall-empty", {"robot": {"scans": 60}, "laser": laser})
    return simulate(scene, 0).recording


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    (tmp_path / "yag_slam").mkdir()
    for name, text in STAND_IN.items():
        (tmp_path / "yag_slam" / f"{name}.py").write_text(text)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")


@pytest.mark.usefixtures("stand_in")
def test_poses_are_of_the_base_and_scans_between_follow_odometry(recording):
    found = karto.mapped(recording, sys.executable)
    aside = se2.matrix(0.0, 10.0, 0.0)
    np.testing.assert_allclose(found.poses, aside @ recording.T_odom_base, atol=1e-9)
    assert 5 < found.taken < 55
    assert found.closed == found.taken // 2
    assert 0.002 * found.taken <= found.cpu < found.process_cpu


def test_ranges_are_those_of_the_beams(recording):
    first, step, ranges = karto.evenly(recording)
    angles = first + step * np.arange(90)
    ahead = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    points = (ranges[..., None] * ahead).reshape(-1, 2)
    np.testing.assert_allclose(points[recording.hit], recording.points[recording.hit], atol=1e-4)
    np.testing.assert_array_equal(np.isnan(ranges.ravel()), ~recording.hit)


def test_a_scan_is_taken_after_half_a_metre_or_half_a_radian():
    x = np.array([0.0, 0.3, 0.49, 0.51, 0.9, 0.9, 0.9, 1.41])
    heading = np.array([0.0, 0, 0, 3.0, -3.1, -2.7, -2.4, -2.4])
    taken = karto.moved(se2.matrix(x, np.zeros(8), heading))
    # from 3.0 it is not far to -3.1
    assert taken.tolist() == [0, 3, 5, 7]
