"""Beam times of spinning lidars."""

import math
from dataclasses import replace

import numpy as np
import pytest

from stillmap import slam
from stillmap.cli.recording_info import summarize_recording
from stillmap.io import read, writers
from stillmap.pipeline.options import Options
from stillmap.prepare.beam_times import add_beam_times, turns_since_stamp
from stillmap.prepare.options import ReadOptions
from stillmap.sim import scene_by_name, simulate

LEFT = "counter-clockwise"


@pytest.fixture(scope="module")
def sweeps():
    """A lidar that turns to the left, from behind, on a car that turns, too."""
    lidar = {"channels": 16, "columns": 360}
    return simulate(scene_by_name("street-turn", {"lidar": lidar, "robot": {"scans": 25}}), 0)


@pytest.fixture
def timeless(sweeps):
    return replace(sweeps.recording, beam_time=None)


def test_times_come_back(sweeps, timeless):
    found = add_beam_times(timeless, LEFT).beam_time
    usable = np.isfinite(sweeps.recording.points).all(axis=1)
    away = np.abs(found - sweeps.recording.beam_time)[usable]
    # beams of the very first column are as well those of the last
    assert np.mean(away > 1e-5) < 2.0 / 360


def test_sweeps_are_straightened_as_by_recorded_times(sweeps, timeless):
    chosen = Options().slam
    poses = sweeps.truth.T_world_base
    true, found, left = (
        slam.deskew_recording(r, poses, chosen).points
        for r in (sweeps.recording, add_beam_times(timeless, LEFT), timeless)
    )
    hit = sweeps.recording.hit
    error, before = (np.linalg.norm(p - true, axis=1)[hit] for p in (found, left))
    assert np.quantile(error, 0.99) < 1e-3
    assert np.quantile(before, 0.99) > 0.3


@pytest.mark.parametrize(
    ("direction", "stamp", "azimuth", "turns"),
    [
        ("clockwise", math.pi, 0.5 * math.pi, 0.25),
        ("clockwise", 0.0, 0.5 * math.pi, -0.25),
        ("clockwise", 0.0, -0.5 * math.pi, 0.25),
        ("counter-clockwise", 0.0, 0.5 * math.pi, 0.25),
        ("counter-clockwise", 0.5 * math.pi, -0.5 * math.pi, -0.5),
    ],
)
def test_turns(direction, stamp, azimuth, turns):
    point = np.array([[3 * math.cos(azimuth), 3 * math.sin(azimuth), -1.0]], np.float32)
    assert turns_since_stamp(point, direction, stamp) == pytest.approx([turns], abs=1e-6)


def test_recorded_times_are_kept(sweeps):
    found = add_beam_times(sweeps.recording, LEFT)
    assert found.beam_time is sweeps.recording.beam_time
    assert any("times of their own" in text for text in found.source.warnings)


def test_kitti_looks_ahead_at_the_stamp(tmp_path, timeless):
    writers.write(timeless, tmp_path / "a", name="kitti")
    assert read(tmp_path / "a").beam_time is None  # its sequences
    times = read(tmp_path / "a", ReadOptions(spin=LEFT)).beam_time
    assert -0.051 < times.min() < -0.049
    assert 0.049 < times.max() < 0.051


def test_raw_drives_of_kitti_turn_clockwise(tmp_path, timeless):
    writers.write(timeless, tmp_path / "a", name="kitti")
    (tmp_path / "raw" / "velodyne_points").mkdir(parents=True)
    (tmp_path / "a" / "velodyne").rename(tmp_path / "raw" / "velodyne_points" / "data")
    (tmp_path / "a" / "times.txt").rename(tmp_path / "raw" / "velodyne_points" / "timestamps.txt")
    drive = read(tmp_path / "raw")
    assert summarize_recording(drive)["spin"] == "clockwise"
    x, y, _ = drive.points.T
    left = np.abs(np.arctan2(y, x) - math.pi / 2) < 0.02
    np.testing.assert_allclose(drive.beam_time[left], -0.025, atol=0.001)
    assert read(tmp_path / "raw", ReadOptions(spin="none")).beam_time is None
