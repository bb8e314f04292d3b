"""A tilting laser in the same bag as a level one."""

import json
from contextlib import closing

import numpy as np
import pytest
from small_bags import Messages, turned, write_bag

from stillmap.cli.main import main
from stillmap.core import se2
from stillmap.io import writers
from stillmap.io.builder import ReadContext
from stillmap.io.ros.bag import Bag
from stillmap.io.ros.reader import read as read_bags
from stillmap.prepare.options import ReadOptions
from stillmap.prepare.prepare import interpret
from stillmap.sim import load_truth, scene_by_name, simulate, write_simulation
from stillmap.sim.laser import compute_beam_angles
from stillmap.sim.lidar import compute_joint_angle
from stillmap.sim.options import RigOptions

NOD = {"tilts": True, "period": 2.0}
JOINT_NS = 5_000_000  # from one transform of the joint to the next; turns happen at some of them
QUICK = ("--quiet", "--threads", "1", "--set", "em.max_iterations=1")

TILT = ReadContext(ReadOptions(topic="tilt_scan", base_frame="base_link"))


@pytest.fixture(scope="module")
def rig():
    """A hall with people, for 8 s."""
    changes = {
        "rig": NOD,
        "laser": {"beams": 91, "sweep_time": 0.02, "max_range": 12.0},
        "robot": {"scans": 200, "scan_rate": 25.0},
        "crowd": {"people": 25},
    }
    return simulate(scene_by_name("hall", changes), 5)


def scans(messages, recording, frame, laser):
    """LaserScan messages of a recording, from the ends of its beams."""
    angles, n = compute_beam_angles(laser.beams, laser.fov), laser.beams
    length = np.linalg.norm(recording.points, axis=1)
    ranges = np.where(recording.hit, length, np.inf).reshape(-1, n)
    shape = {
        "angle_min": angles[0],
        "angle_max": angles[-1],
        "angle_increment": angles[1] - angles[0],
        "time_increment": laser.sweep_time / (n - 1),
        "range_max": laser.max_range,
    }
    for stamp, readings in zip(recording.stamp_ns.tolist(), ranges, strict=True):
        yield stamp, messages.scan(stamp, readings, frame, **shape)


def joint_messages(messages, rig, joint_ns):
    """Transforms of the joint at their own stamps."""
    start = int(rig.tilting.recording.stamp_ns[0])
    o = RigOptions(**NOD)
    half = 0.5 * compute_joint_angle((joint_ns - start) / 1e9, o)
    for stamp, a in zip(joint_ns.tolist(), half, strict=True):
        turn = (0.0, np.sin(a), 0.0, np.cos(a))
        at = (o.pivot_x, 0.0, o.pivot_z)
        yield stamp, messages.tf(messages.transform(stamp, "base_link", "tilt", at, turn))


def bag_of(folder, rig, joint_ns=None, kind="mcap"):
    """A bag of both lasers, odometry, and the joint's transforms."""
    messages = Messages("ros1" if kind == "bag" else "cdr")
    flat, tilting = rig.recording, rig.tilting.recording
    laser = rig.scene.laser
    first, last = int(flat.stamp_ns[0]), int(flat.stamp_ns[-1]) + 100_000_000
    if joint_ns is None:
        joint_ns = np.arange(first, last, JOINT_NS)
    x, y, yaw = se2.parameters(flat.T_base_sensor)[0]
    fixed = messages.transform(first, "base_link", "laser", (x, y, 0.35), turned(yaw))
    content = [("/tf_static", first, messages.tf(fixed))]
    content += [("/scan", at, m) for at, m in scans(messages, flat, "laser", laser)]
    content += [("/tilt_scan", at, m) for at, m in scans(messages, tilting, "tilt", laser)]
    content += [("/tf", at, m) for at, m in joint_messages(messages, rig, joint_ns)]
    for stamp, T in zip(flat.stamp_ns.tolist(), flat.T_odom_base, strict=True):
        x, y, yaw = se2.parameters(T[None])[0]
        at = messages.tf(messages.transform(stamp, "odom", "base_link", (x, y, 0.0), turned(yaw)))
        content.append(("/tf", stamp, at))
    return write_bag(folder, kind, messages, sorted(content, key=lambda one: one[1]), "rig")


def read_tilting(context, *paths):
    return interpret(read_bags(paths, context, tilting=True), context.options, None)


@pytest.fixture(scope="module")
def path(rig, tmp_path_factory):
    return bag_of(tmp_path_factory.mktemp("bag"), rig)


def in_base(recording):
    """Ends of beams on the robot, metres."""
    T = recording.T_base_sensor[recording.sensor].repeat(np.diff(recording.offset), axis=0)
    return np.einsum("nij,nj->ni", T[:, :3, :3], recording.points.astype(float)) + T[:, :3, 3]


def test_points_follow_the_joint(rig, path):
    found, true = read_tilting(TILT, path), rig.tilting.recording
    assert found.dimension == 3
    np.testing.assert_array_equal(found.stamp_ns, true.stamp_ns)
    np.testing.assert_array_equal(found.hit, true.hit)
    np.testing.assert_allclose(found.beam_time, true.beam_time, atol=1e-6)
    off = np.linalg.norm(in_base(found) - in_base(true), axis=1)[true.hit]
    assert off.max() < 2e-3
    # each scan's sensor is tilted as at its stamp
    down = np.arcsin(-found.T_base_sensor[:, 2, 0])
    np.testing.assert_allclose(down, rig.joint_angle, atol=1e-4)


def test_a_bag_in_parts(path, tmp_path):
    messages = Messages("cdr")
    with closing(Bag([path], None, trusted=True)) as whole:
        content = [
            (message.channel.topic, message.log_ns, (message.channel.type, message.raw))
            for message in whole.messages({channel.topic for channel in whole.channels})
        ]
    half = len(content) // 2
    parts = [
        write_bag(tmp_path, "mcap", messages, part, name)
        for name, part in (("a", content[:half]), ("b", content[half:]))
    ]
    found, wanted = read_tilting(TILT, *parts), read_tilting(TILT, path)
    np.testing.assert_array_equal(found.stamp_ns, wanted.stamp_ns)
    np.testing.assert_array_equal(found.points, wanted.points)
    np.testing.assert_array_equal(found.T_base_sensor, wanted.T_base_sensor)


def test_beams_without_transforms_are_unusable(rig, tmp_path):
    stamps = rig.tilting.recording.stamp_ns
    first, last = int(stamps[0]), int(stamps[-1]) + 100_000_000
    joint_ns = np.arange(first, last, JOINT_NS)
    after = (joint_ns - first) / 1e9
    joint_ns = joint_ns[(after >= 1.0) & ((after <= 3.0) | (after >= 5.0))]
    found = read_tilting(TILT, bag_of(tmp_path, rig, joint_ns))
    taken = (stamps.repeat(91) - first) / 1e9 + found.beam_time
    known = (taken >= 1.0) & ((taken <= 3.0) | (taken >= 5.0))
    np.testing.assert_array_equal(found.hit, rig.tilting.recording.hit & known)
    assert np.isnan(found.points[~known]).all()
    assert any("do not say how the laser is tilted" in w for w in found.source.warnings)


def test_map_command(rig, path, tmp_path):
    out = tmp_path / "out"
    words = ("map", path, "--tilting-topic", "/tilt_scan", "-o", out, "--mesh", *QUICK)
    assert main([str(word) for word in words]) == 0
    write_simulation(rig, tmp_path / "sim")
    p_static = np.load(out / "tilting/beams/p_static.npy")
    truth = load_truth(tmp_path / "sim" / "tilting")
    known = rig.tilting.recording.hit & ~np.isnan(p_static)
    removed, static = p_static[known] < 0.5, truth.static[known]
    assert (~static).sum() > 100
    assert removed[~static].mean() > 0.85
    assert removed[static].mean() < 0.01
    record = json.loads((out / "run.json").read_text())
    assert record["tilting"]["input"]["path"] == str(path)
    assert record["options"]["read"]["tilting_topic"] == "/tilt_scan"
    assert record["models"]["area"] > 100.0  # m2: floor, walls and ceiling


def test_point_clouds_instead_of_scans(rig, tmp_path):
    writers.write(rig.tilting.recording, tmp_path / "a.mcap")
    wanted = ReadContext(ReadOptions(topic="/points", base_frame="base_link"))
    found = read_tilting(wanted, tmp_path / "a.mcap")
    hit = rig.tilting.recording.hit
    np.testing.assert_array_equal(found.points[hit], rig.tilting.recording.points[hit])
