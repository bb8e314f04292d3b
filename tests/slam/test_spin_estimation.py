"""The direction in which a lidar spins, found from sweeps that its motion distorts."""

import dataclasses
import functools

import numpy as np
import pytest

import stillmap
from stillmap.core import se3
from stillmap.core.config import override
from stillmap.io import writers
from stillmap.pipeline.calibration import time_sweeps
from stillmap.pipeline.options import Options
from stillmap.pipeline.result import map_recording
from stillmap.slam.options import SlamOptions
from stillmap.slam.spin_estimation import estimate_spin

pytestmark = pytest.mark.slow

SWEEPS, PERIOD = 64, 0.1
TWIST = np.array([4.0, 0.0, 0.0, 0.0, 0.0, 0.6])  # m/s and rad/s of the base: a wide curve
SIGN = {"clockwise": -1.0, "counter-clockwise": 1.0, "none": 0.0}


def surfaces(rng, n=12_000):
    """(n, 3) points of a yard: ground, four walls, and twelve square pillars."""
    u, v, where = rng.random((3, n))
    side, along, height = rng.integers(0, 4, n), 32.0 * u - 16.0, 5.0 * v - 1.0
    wall = np.stack([along, np.full(n, 16.0), height], axis=1)
    turn = np.array([[[1, 0], [0, 1]], [[0, -1], [1, 0]], [[-1, 0], [0, -1]], [[0, 1], [-1, 0]]])
    wall[:, :2] = np.einsum("nij,nj->ni", turn[side], wall[:, :2])
    ground = np.stack([along, 32.0 * v - 16.0, np.full(n, -1.0)], axis=1)
    corner = 24.0 * rng.random((12, 2)) - 12.0
    pillar = np.stack([2.0 * u - 1.0, np.ones(n), height], axis=1)
    pillar[:, :2] = np.einsum("nij,nj->ni", turn[side], pillar[:, :2])
    pillar[:, :2] += corner[rng.integers(0, 12, n)]
    return np.where((where < 0.2)[:, None], ground, np.where((where < 0.6)[:, None], wall, pillar))


def sweep(world, t, direction, pace):
    """Points (n, 3) of a world in the lidar's frame, each at the moment at which it looks there."""
    tau = np.zeros(len(world))
    for _ in range(4):  # the azimuth depends on the time, and the time on the azimuth
        T = se3.exp(np.multiply.outer(t * PERIOD + tau, pace * TWIST))
        local = np.einsum("nji,nj->ni", T[:, :3, :3], world - T[:, :3, 3])
        azimuth = np.arctan2(local[:, 1], local[:, 0])
        tau = PERIOD * np.mod(SIGN[direction] * (azimuth - np.pi), 2 * np.pi) / (2 * np.pi)
    return local


@functools.cache
def drive(direction, pace=1.0, every=1):
    """A recording without beam times, of every so many sweeps.

    Direction `none`: each sweep is taken at once.
    """
    rng = np.random.default_rng(0)
    world = surfaces(rng)
    turns = every * np.arange(SWEEPS)
    seen = [world[rng.random(len(world)) < 0.6] for _ in turns]
    exact = [sweep(points, t, direction, pace) for t, points in zip(turns, seen, strict=True)]
    scans = [(points + rng.normal(0.0, 0.01, points.shape)).astype("f4") for points in exact]
    return stillmap.Recording.from_clouds(PERIOD * turns, scans)


@pytest.mark.parametrize("direction", ["clockwise", "counter-clockwise"])
def test_the_direction_is_found(direction):
    assert estimate_spin(drive(direction), SlamOptions()) == direction


def test_other_sweeps_stay_as_they_are():
    recording = drive("clockwise")
    ahead = dataclasses.replace(recording, hit=recording.hit & (recording.points[:, 0] > 0.0))
    # a turn of thinned sweeps seems to take five times as long: times would add distortion
    thinned = drive("clockwise", pace=0.3, every=5)
    for sweeps in (drive("none"), thinned, ahead):
        assert estimate_spin(sweeps, SlamOptions()) is None


def test_mapping_with_the_direction():
    recording = drive("clockwise")
    options = override(Options(), {"threads": 1, "em": {"max_iterations": 1}})
    result = map_recording(recording, options)
    assert result.options.read.spin == "clockwise"
    as_is = override(options, {"read": {"spin": "none"}})
    before = map_recording(recording, as_is)
    assert before.recording.beam_time is None
    assert np.mean(result.p_static < 0.5) < 0.3 * np.mean(before.p_static < 0.5)  # nothing moves


def test_saved_results_have_the_beam_times_again(tmp_path):
    recording = drive("counter-clockwise")
    built = stillmap.build(recording, {"threads": 1, "em.max_iterations": 1})
    assert any("turns counter-clockwise" in warning for warning in built.warnings)
    built.save(tmp_path / "out")
    loaded = stillmap.load(tmp_path / "out", recording=recording)
    np.testing.assert_array_equal(loaded.recording.beam_time, built.recording.beam_time)
    # poses are rounded to the digits of the file
    np.testing.assert_allclose(loaded.deskewed.points, built.deskewed.points, atol=1e-5)


def test_a_reader_that_was_told_of_no_spin_is_believed(tmp_path):
    writers.write(drive("clockwise"), tmp_path / "drive", name="kitti")
    recording = stillmap.read(tmp_path / "drive", stillmap.ReadOptions(spin="none"))
    assert time_sweeps(recording, Options())[0] is recording


@pytest.mark.parametrize("spin", ["none", "clockwise"])
def test_what_the_user_says_is_not_estimated(spin):
    options = override(Options(), {"read": {"spin": spin}})
    recording = drive("counter-clockwise")
    assert time_sweeps(recording, options) == (recording, options, [])
