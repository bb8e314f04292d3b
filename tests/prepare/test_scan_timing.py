"""Beam times of spinning lidars."""

import math
from dataclasses import replace

import numpy as np
import pytest

from stillmap import slam
from stillmap.cli.main import main
from stillmap.cli.recording_info import summarize_recording
from stillmap.core import config
from stillmap.core.errors import InputError
from stillmap.io import read, stillmap_folder, writers
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


def test_unusable_beams_have_a_time_all_the_same():
    assert turns_since_stamp(np.full((1, 3), np.nan, np.float32), LEFT).tolist() == [0.0]


def test_a_turn_lasts_from_stamp_to_stamp(timeless):
    last = add_beam_times(timeless, LEFT).beam_time.max()
    assert last == pytest.approx(0.1, abs=1e-3)


def test_recorded_times_are_kept(sweeps):
    found = add_beam_times(sweeps.recording, LEFT)
    assert found.beam_time is sweeps.recording.beam_time
    assert any("times of their own" in text for text in found.source["warnings"])


def test_stamps_that_tell_no_rate(timeless):
    odd = replace(
        timeless, stamp_ns=timeless.stamp_ns[0] + 100 * (timeless.stamp_ns - timeless.stamp_ns[0])
    )
    found = add_beam_times(odd, LEFT)
    assert found.beam_time is None
    assert any("rate of turns" in text for text in found.source["warnings"])


@pytest.mark.parametrize("form", ["stillmap", "pcd"])
def test_only_who_is_asked_for_it(tmp_path, timeless, form):
    writers.write(timeless, tmp_path / "a", name=form)
    assert read(tmp_path / "a").beam_time is None
    assert read(tmp_path / "a", ReadOptions(spin=LEFT)).beam_time is not None


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


def test_recordings_that_were_timed_so_are_read_again_as_they_are(tmp_path, timeless):
    stillmap_folder.write(add_beam_times(timeless, LEFT), tmp_path / "a")
    again = read(tmp_path / "a", ReadOptions(spin="clockwise"))
    np.testing.assert_array_equal(again.beam_time, add_beam_times(timeless, LEFT).beam_time)


def test_the_flag(tmp_path, timeless, capsys):
    stillmap_folder.write(timeless, tmp_path / "a")
    assert main(["info", str(tmp_path / "a"), "--spin", "clockwise", "--quiet"]) == 0
    assert "as it turns clockwise" in capsys.readouterr().out


@pytest.mark.parametrize("text", ["spin='left'", "spin=1", "spin_rate=10"])
def test_odd_options(text):
    with pytest.raises((InputError, ValueError)):
        config.override(Options(), config.parse_assignment(f"read.{text}"))


def test_recordings_in_the_plane_are_refused(tmp_path):
    flat = simulate(scene_by_name("hall", {"robot": {"scans": 3}}), 0).recording
    stillmap_folder.write(flat, tmp_path / "a")
    with pytest.raises(InputError, match="is for 3D"):
        read(tmp_path / "a", ReadOptions(spin=LEFT))
