"""Planar scans and a joint make a recording in 3D, and its sweeps."""

import functools

import numpy as np
import pytest
from recordings import of_one_sensor

from stillmap.core.recording import Recording
from stillmap.prepare.beam_times import assemble_tilting_laser
from stillmap.sim import scene_by_name, simulate


@functools.cache
def rig():
    laser = {"sweep_time": 0.02, "beams": 61}
    robot = {"scans": 60, "scan_rate": 20.0}
    return simulate(
        scene_by_name("hall", {"laser": laser, "robot": robot, "rig": {"tilts": True}}), 3
    )


def test_simulated_rig_from_planar_scans():
    whole, joint = rig().tilting.recording, rig().joint_angle
    # the joint goes on evenly while a scan is taken, but for the one in which it turns round
    even = np.flatnonzero(np.abs(np.diff(joint, 2, prepend=joint[0], append=joint[-1])) < 1e-9)
    length = np.linalg.norm(whole.points.astype(float), axis=1)
    beam = np.tile(np.linspace(-np.pi / 2, np.pi / 2, 61), 60)
    flat = Recording(
        stamp_ns=whole.stamp_ns,
        offset=whole.offset,
        points=(length[:, None] * np.stack([np.cos(beam), np.sin(beam)], axis=1)).astype("f4"),
        hit=whole.hit,
        T_base_sensor=np.eye(3)[None],
        sensor=whole.sensor,
        T_odom_base=None,
        beam_time=whole.beam_time,
    )
    found = assemble_tilting_laser(
        flat, whole.stamp_ns, joint, (0.0, 1.0, 0.0), whole.T_base_sensor[0]
    )
    of_even = np.isin(whole.scans_of(np.arange(whole.n_beams)), even)
    of_even &= (
        whole.scans_of(np.arange(whole.n_beams)) < 59
    )  # after its stamp nobody read the joint
    assert of_even.mean() > 0.8
    np.testing.assert_allclose(found.points[of_even], whole.points[of_even], atol=2e-3)
    np.testing.assert_array_equal(found.T_base_sensor, whole.T_base_sensor)


def test_laser_beside_the_joint():
    flat = of_one_sensor(
        np.array([0], np.int64),
        np.array([0, 1]),
        np.array([[2.0, 0.0]], np.float32),
        np.ones(1, bool),
    )
    T = np.eye(4)
    T[0, 3] = 0.5
    angle = np.array([np.pi / 2])
    pans = assemble_tilting_laser(flat, flat.stamp_ns, angle, (0.0, 0.0, 1.0), np.eye(4), T)
    np.testing.assert_allclose(pans.points, [[0.0, 2.5, 0.0]], atol=1e-6)
    nods = assemble_tilting_laser(flat, flat.stamp_ns, angle, (0.0, 1.0, 0.0), np.eye(4), T)
    np.testing.assert_allclose(nods.points, [[0.0, 0.0, -2.5]], atol=1e-6)
    with pytest.raises(ValueError, match="1 stamps, 2 angles"):
        assemble_tilting_laser(flat, flat.stamp_ns, np.zeros(2), (0.0, 1.0, 0.0), np.eye(4))
