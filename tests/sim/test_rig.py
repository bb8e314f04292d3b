"""A laser that lies flat and one that tilts: one world, one clock, two recordings."""

import functools

import numpy as np
import pytest

from stillmap import io as recordings
from stillmap.core.errors import InputError
from stillmap.sim import load_truth, scene_by_name, simulate, write_simulation
from stillmap.sim.options import RigOptions


@functools.cache
def run(sweep_time=0.0):
    laser = {"range_noise": 0.0, "no_return_share": 0.0, "sweep_time": sweep_time}
    robot = {"scans": 100, "scan_rate": 10.0}
    changes = {"laser": laser, "robot": robot, "rig": {"tilts": True}}
    return simulate(scene_by_name("hall", changes), 3)


def test_both_have_the_same_clock_robot_and_movers():
    flat, tilting = run(), run().tilting
    assert (flat.recording.dimension, tilting.recording.dimension) == (2, 3)
    np.testing.assert_array_equal(flat.recording.stamp_ns, tilting.recording.stamp_ns)
    np.testing.assert_array_equal(flat.truth.movers, tilting.truth.movers)
    for a, b in (
        (flat.truth.T_world_base, tilting.truth.T_world_base),
        (flat.recording.T_odom_base, tilting.recording.T_odom_base),
    ):
        np.testing.assert_allclose(a[:, :2, 2], b[:, :2, 3])
        np.testing.assert_allclose(a[:, :2, :2], b[:, :2, :2])


def test_each_scan_is_a_plane_at_the_angle_of_its_joint():
    recording, angle = run().tilting.recording, run().joint_angle
    points = recording.points.reshape(100, -1, 3)
    off = points[..., 2] * np.cos(angle)[:, None] + points[..., 0] * np.sin(angle)[:, None]
    assert np.abs(off).max() < 1e-5
    rig = RigOptions()
    assert angle[0] == pytest.approx(rig.middle)
    assert angle.max() == pytest.approx(rig.middle + rig.amplitude)
    assert angle.min() == pytest.approx(rig.middle - rig.amplitude)
    assert np.abs(np.diff(angle)).max() == pytest.approx(4 * rig.amplitude / rig.period / 10)
    np.testing.assert_allclose(angle[:40], angle[40:80], atol=1e-12)


def test_floor_ceiling_and_walls_are_seen_in_3d(end_points):
    tilting = run().tilting
    recording, truth = tilting.recording, tilting.truth
    ends, scan = end_points(tilting)
    z = ends[recording.hit, 2]
    assert z.min() > -1e-4
    assert z.max() < 6.0 + 1e-4
    assert (np.abs(z) < 1e-4).mean() > 0.1
    assert (np.abs(z - 6.0) < 1e-4).mean() > 0.02
    person = truth.mover >= 0
    assert person.sum() > 100
    at = truth.movers[scan[person], truth.mover[person], :2]
    assert np.hypot(*(ends[person, :2] - at).T).max() < 0.6


def test_a_folder_of_both(tmp_path):
    write_simulation(run(), tmp_path / "rig")
    for name, one in (("horizontal", run()), ("tilting", run().tilting)):
        read, truth = recordings.read(tmp_path / "rig" / name), load_truth(tmp_path / "rig" / name)
        np.testing.assert_array_equal(read.points, one.recording.points)
        np.testing.assert_array_equal(truth.mover, one.truth.mover)
    np.testing.assert_array_equal(np.load(tmp_path / "rig/joint_angle.npy"), run().joint_angle)
    with pytest.raises(InputError, match="already"):
        write_simulation(run(), tmp_path / "rig")
    write_simulation(run(), tmp_path / "rig", overwrite=True)
