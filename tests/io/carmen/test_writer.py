"""Recordings written as CARMEN logs and read back."""

import dataclasses
import gzip

import numpy as np
import pytest

from stillmap.core.errors import InputError
from stillmap.io import read, writers
from stillmap.io.carmen import writer
from stillmap.sim import scene_by_name, simulate


def simulated(scans=10, **laser):
    scene = scene_by_name("hall", {"robot": {"scans": scans}, "laser": laser})
    return simulate(scene, 4).recording


def again(recording, path):
    """Write and read a recording; check what holds for every kind of line."""
    writers.write(recording, path)
    found = read(path)
    assert found.source.skipped == found.source.skipped_odometry == {}
    assert found.source.warnings == []
    np.testing.assert_array_equal(found.stamp_ns, recording.stamp_ns)
    np.testing.assert_array_equal(found.offset, recording.offset)
    np.testing.assert_array_equal(found.sensor, recording.sensor)
    np.testing.assert_array_equal(found.hit, recording.hit)
    np.testing.assert_allclose(
        found.points[found.hit], recording.points[found.hit], rtol=0, atol=6e-5
    )
    np.testing.assert_array_equal(np.isnan(found.points), np.isnan(recording.points))
    np.testing.assert_allclose(found.T_base_sensor, recording.T_base_sensor, atol=3e-6)
    if recording.T_odom_base is None:
        assert found.T_odom_base is None
    else:
        np.testing.assert_allclose(found.T_odom_base, recording.T_odom_base, atol=2e-6)
    return found


def kinds(recording):
    return [one.name for one in recording.source.sensors]


@pytest.mark.parametrize("beams", [180, 361])
@pytest.mark.parametrize("two", [False, True])
def test_half_circle(tmp_path, beams, two):
    recording = simulated(beams=beams, second_laser=two, x=0.2, y=-0.1, yaw=0.3)
    found = again(recording, tmp_path / "a.log")
    assert kinds(found) == ["FLASER", "RLASER"][: 1 + two]


def test_other_fields_of_view(tmp_path):
    recording = simulated(beams=541, fov=np.radians(270), second_laser=True)
    assert kinds(again(recording, tmp_path / "a.log")) == ["ROBOTLASER1", "ROBOTLASER2"]


def test_ranges_beyond_flaser(tmp_path):
    recording = simulated(max_range=30.0)
    far = dataclasses.replace(recording, points=recording.points * np.float32(4.0))
    found = again(far, tmp_path / "a.log")
    assert kinds(found) == ["ROBOTLASER1"]
    length = np.linalg.norm(found.points[~found.hit], axis=1)
    np.testing.assert_allclose(length, 120.0, rtol=0.02)  # as far as 99.9 % of the hits


def test_without_odometry(tmp_path):
    recording = simulated(second_laser=True, x=0.2, y=-0.1, yaw=0.3).without_odometry()
    assert kinds(again(recording, tmp_path / "a.log")) == ["RAWLASER1", "RAWLASER2"]


@pytest.mark.parametrize("fov", [180, 240])
@pytest.mark.parametrize("odometry", [True, False])
def test_clockwise_beams(tmp_path, fov, odometry):
    recording = simulated(fov=np.radians(fov), upside_down="known", x=0.2)
    recording = recording if odometry else recording.without_odometry()
    found = again(recording, tmp_path / "a.log")
    assert found.source.sensors[0].upside_down


@pytest.mark.parametrize("share", [0.002, 0.3])
def test_unusable_beams(tmp_path, share):
    recording = simulated(scans=40)
    points, hit = np.array(recording.points), np.array(recording.hit)
    lost = np.random.default_rng(0).random(len(hit)) < share
    points[lost], hit[lost] = np.nan, False
    again(dataclasses.replace(recording, points=points, hit=hit), tmp_path / "a.log")
    text = (tmp_path / "a.log").read_text()
    assert (" nan " in text) == (share > 0.1)
    assert (" 0.0000 " in text) == (share < 0.1)


def test_counts_of_beams_that_alternate(tmp_path):
    recording = simulated(beams=181)
    kept = np.arange(recording.n_beams) % 362 != 0  # every other scan lacks its first beam
    offset = np.concatenate([[0], np.cumsum(kept)])[recording.offset]
    points, hit = recording.points[kept], recording.hit[kept]
    again(dataclasses.replace(recording, offset=offset, points=points, hit=hit), tmp_path / "a.log")


def test_gzip(tmp_path):
    recording = simulated()
    for name in ("a.log", "a.clf.gz", "b.clf.gz"):
        writer.write_log(recording, tmp_path / name)
    packed = (tmp_path / "a.clf.gz").read_bytes()
    assert gzip.decompress(packed) == (tmp_path / "a.log").read_bytes()
    assert (tmp_path / "b.clf.gz").read_bytes() == packed


def test_unsupported_recordings(tmp_path):
    recording = simulated(sweep_time=0.05)
    assert writers.write(recording, tmp_path / "a.log") == [
        "beam times are left out: CARMEN logs cannot hold them"
    ]
    three = dataclasses.replace(recording, T_base_sensor=np.tile(np.eye(3), (3, 1, 1)))
    points = np.array(recording.points)
    points[:180, 1] *= -1
    mixed = dataclasses.replace(recording, points=points)
    empty = np.array(recording.offset)
    empty[1:3] = 0
    none = dataclasses.replace(recording, offset=empty)
    for one, words in (
        (three, "it has 3 sensors, the format holds 2"),
        (mixed, "one way in some scans"),
        (none, "no scan without beams"),
    ):
        with pytest.raises(InputError, match=words):
            writers.write(one, tmp_path / "b.log")
    assert [path.name for path in tmp_path.iterdir()] == ["a.log"]


def test_a_public_log(shared_data, tmp_path):
    recording = read(shared_data / "laser2d" / "aces.clf.gz")
    found = again(recording, tmp_path / "a.log")
    np.testing.assert_allclose(found.points, recording.points, rtol=0, atol=6e-5)
