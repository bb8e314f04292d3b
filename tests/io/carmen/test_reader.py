"""Each kind of CARMEN line against hand-computed numbers."""

import gzip
import math

import numpy as np
import pytest

from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.io import read

HEADER = "0 -1.5707963267948966 3.141592653589793 1.5707963267948966 20.0 0.01 0"


def test_flaser_with_known_numbers(read_log):
    recording = read_log(
        [
            "# CARMEN Logfile",
            "FLASER 4 1.0 2.0 3.0 4.0 0 0 0 0 0 0 976052857.337483 nohost 0.1",
            "FLASER 4 1.5 2.5 3.5 4.5 1 2 0.5 1 2 0.5 976052858.000001 nohost 0.7",
        ]
    )
    assert recording.stamp_ns.tolist() == [976052857337483000, 976052858000001000]
    assert recording.offset.tolist() == [0, 4, 8]
    # four readings, an even number: 45 degrees apart from -90, the last of the half circle left out
    angle = np.radians([-90.0, -45.0, 0.0, 45.0])
    expected = np.array([1.0, 2.0, 3.0, 4.0])[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    np.testing.assert_allclose(recording.points[:4], expected, atol=1e-6)
    assert recording.hit.all()
    assert recording.T_odom_base is not None
    np.testing.assert_allclose(se2.parameters(recording.T_odom_base), [[0, 0, 0], [1, 2, 0.5]])
    np.testing.assert_array_equal(recording.T_base_sensor, np.eye(3)[None])
    assert recording.source.odometry["from"] == "scan lines"
    assert recording.source.ignored == {"comments": 1}


@pytest.mark.parametrize(
    ("n", "last_deg", "step_deg"),
    [(180, 89.0, 1.0), (181, 90.0, 1.0), (360, 89.5, 0.5), (361, 90.0, 0.5), (5, 90.0, 45.0)],
)
def test_flaser_angles(read_log, flaser, n, last_deg, step_deg):
    recording = read_log([flaser(1.0, [2.0] * n)])
    angle = np.degrees(np.arctan2(recording.points[:, 1], recording.points[:, 0]))
    np.testing.assert_allclose(angle, -90.0 + step_deg * np.arange(n), atol=1e-4)
    assert angle[-1] == pytest.approx(last_deg, abs=1e-4)


def test_front_and_rear_laser(read_log, flaser):
    recording = read_log(
        [
            flaser(1.0, pose=(1.0, 0, 0)),
            flaser(1.2, [5.0, 6.0], pose=(1.2, 0, 0), kind="RLASER"),
            flaser(1.1, [5.5, 6.5], pose=(1.1, 0, 0), kind="RLASER"),  # late
            flaser(1.15, pose=(1.15, 0, 0)),
            flaser(2.0, [7.0, 8.0], pose=(2.0, 0, 0), kind="RLASER"),
        ]
    )
    np.testing.assert_array_equal(recording.stamp_ns / 1e9, [1.0, 1.1, 1.15, 1.2, 2.0])
    assert recording.sensor.tolist() == [0, 1, 0, 1, 1]
    np.testing.assert_array_equal(recording.T_odom_base[:, 0, 2], recording.stamp_ns / 1e9)
    x, y, theta = se2.parameters(recording.T_base_sensor[1])
    assert (x, y, abs(theta)) == (0.0, 0.0, pytest.approx(math.pi))
    lengths = np.linalg.norm(recording.points[4:], axis=1)
    np.testing.assert_allclose(lengths, [5.5, 6.5, 1, 2, 3, 4, 5, 6, 7, 8], rtol=1e-6)
    assert recording.source.skipped == {}


@pytest.mark.parametrize("own_poses", [True, False])
@pytest.mark.parametrize(("back", "kept"), [(30.1, 239), (1000.0, 198)])
def test_late_lines_are_sorted_and_a_clock_set_back_is_none(
    read_log, flaser, own_poses, back, kept
):
    """A robot drives 1 m/s; its scans come in pairs, the later one first; x in m is the time in s,
    the first reading is the centimetres of it. After 100 s the clock is set back."""
    lines = []
    for k in range(0, 300):
        t = (k ^ 1) * 0.5
        stamp = t if t < 100.0 else t - back
        pose = (t, 0, 0)
        lines.append(f"ODOM {k * 0.5} 0 0 0 0 0 {k * 0.5 - (k >= 200) * back} host 0")
        lines.append(flaser(stamp, [1.0 + 0.01 * t, 2.0], pose if own_poses else (0, 0, 0)))
    recording = read_log(lines)
    x, read = recording.T_odom_base[:, 0, 2], np.linalg.norm(recording.points[::2], axis=1)
    # odometry lines and scans may leave the first clock at another scan
    wrong = np.abs(1.0 + 0.01 * x - read) > 1e-5
    assert np.count_nonzero(wrong) <= (not own_poses)
    assert np.all(np.diff(x) > 0.0)
    assert np.count_nonzero(np.diff(x) > 2.0) <= 1, "it leaps where the clock was set"
    assert recording.n_scans == kept
    assert recording.source.skipped["time running backwards"].count == 300 - kept


def test_interlaced_scans_have_angles_of_their_own(read_log):
    """A laser of a degree that looks a quarter of one further in each of four scans."""
    lines = []
    for k in range(40):
        start, n = -90.0 + 0.25 * (k % 4), 181 if k % 4 == 0 else 180
        header = f"0 {math.radians(start)} {math.radians(n - 1)} {math.radians(1.0)} 50 0.01 0"
        readings = " ".join(["4.0"] * n)
        lines.append(f"ROBOTLASER1 {header} {n} {readings} 0 0 0 0 {k} 0 0 0 0 0 0 0 {k} host {k}")
    recording = read_log(lines)
    assert recording.source.skipped == {}
    assert recording.source.sensors[0].beams_per_scan == 180
    np.testing.assert_array_equal(np.diff(recording.offset), [181, 180, 180, 180] * 10)
    angles = np.degrees(np.arctan2(recording.points[:, 1], recording.points[:, 0]))
    for k in range(recording.n_scans):
        own = angles[recording.beams_of(k)]
        np.testing.assert_allclose(own, -90.0 + 0.25 * (k % 4) + np.arange(len(own)), atol=1e-4)


def test_rawlaser_interpolates_odometry(read_log):
    recording = read_log(
        [
            f"ODOM 0 0 {math.pi - 0.1} 0 0 0 10.0 host 0.0",
            f"RAWLASER1 {HEADER} 3 1.0 2.0 3.0 2 40 50 10.25 host 0.3",
            f"RAWLASER1 {HEADER} 3 1.0 2.0 20.0 0 12.0 host 0.4",
            f"ODOM 4 2 {-math.pi + 0.1} 0 0 0 11.0 host 1.0",
        ]
    )
    poses = se2.parameters(recording.T_odom_base)
    # a quarter of the way; the heading turns 0.2 rad over the cut at pi, not back around
    np.testing.assert_allclose(poses[0], [1.0, 0.5, math.pi - 0.05], atol=1e-12)
    np.testing.assert_allclose(poses[1], [4.0, 2.0, -math.pi + 0.1], atol=1e-12)
    assert recording.source.odometry["outside"] == 1
    np.testing.assert_allclose(recording.points[:3], [[0, -1], [2, 0], [0, 3]], atol=1e-6)
    assert recording.hit.tolist() == [True] * 5 + [False], "the declared 20 m is maximum range"


def test_robotlaser_offset_from_its_two_poses(read_log):
    T_base_sensor = se2.matrix(0.2, -0.1, 0.3)
    lines = []
    for i, pose in enumerate([(0, 0, 0), (1, 2, 1.5), (3, 1, -3.0)]):
        laser = se2.parameters(se2.matrix(*pose) @ T_base_sensor)
        fields = " ".join(f"{v:.6f}" for v in (*laser, *pose))
        lines.append(f"ROBOTLASER1 {HEADER} 2 1.0 2.0 1 9 {fields} 0.1 0.2 0.3 0.4 0.5 {i} h 0.1")
    recording = read_log(lines)
    np.testing.assert_allclose(recording.T_base_sensor[0], T_base_sensor, atol=1e-5)
    assert recording.source.sensors[0].extrinsics.how == "scan lines"
    assert se2.parameters(recording.T_odom_base)[1] == pytest.approx((1, 2, 1.5))


def test_flaser_names_the_laser_first_and_the_robot_second(read_log, flaser):
    poses = [(1.0, 2.0, 0.0), (3.0, 4.0, 0.0)]
    lines = [flaser(i, pose=p, laser_pose=(p[0] + 0.3, *p[1:])) for i, p in enumerate(poses)]
    recording = read_log(lines)
    np.testing.assert_allclose(se2.parameters(recording.T_odom_base), poses)
    np.testing.assert_allclose(se2.parameters(recording.T_base_sensor[0]), [0.3, 0, 0], atol=1e-9)


def test_laser_facing_backwards_with_noise(read_log, flaser):
    turned = [math.pi - 1e-3, -math.pi + 1e-3, math.pi - 1e-3, -math.pi + 1e-3]
    lines = [flaser(i, laser_pose=(-0.2, 0, t), kind="RLASER") for i, t in enumerate(turned)]
    recording = read_log(lines)
    x, y, theta = se2.parameters(recording.T_base_sensor[0])
    assert (x, y) == (pytest.approx(-0.2), pytest.approx(0.0))
    assert abs(theta) == pytest.approx(math.pi, abs=2e-3)
    assert recording.source.sensors[0].extrinsics.how == "scan lines"


def test_corrected_laser_poses_are_ignored(read_log, flaser):
    rng = np.random.default_rng(1)
    lines = [
        flaser(i, pose=(i, 0, 0), laser_pose=(i + rng.normal(), rng.normal(), rng.normal() * 0.1))
        for i in range(9)
    ]
    recording = read_log(lines)
    np.testing.assert_array_equal(recording.T_base_sensor[0], np.eye(3))
    assert any("corrected log" in warning for warning in recording.source.warnings)


def test_params_give_the_offset_and_options_override_it(read_log, flaser):
    lines = [
        "PARAM robot_frontlaser_offset 0.25 host 0",
        "PARAM robot_frontlaser_side_offset 0.05 host 0",
        flaser(1.0),
    ]
    recording = read_log(lines)
    np.testing.assert_allclose(se2.parameters(recording.T_base_sensor[0]), [0.25, 0.05, 0.0])
    assert recording.source.params["robot_frontlaser_offset"] == "0.25"
    overridden = read_log(lines, laser_theta=0.5)
    np.testing.assert_allclose(se2.parameters(overridden.T_base_sensor[0]), [0.25, 0.05, 0.5])
    assert overridden.source.sensors[0].extrinsics.how == "given"


def test_param_declares_maximum_range(read_log, flaser):
    lines = ["PARAM robot_front_laser_max 3.0 host 0", flaser(1.0, [1.0, 2.999, 3.0, 4.0])]
    recording = read_log(lines)
    assert recording.hit.tolist() == [True, True, False, False]
    assert recording.source.sensors[0].ranges.threshold == 3.0


def test_duplicate_lines_are_dropped(read_log):
    tail = "1 0 0 1 0 0 0 0 0 0 0"
    recording = read_log(
        [
            f"RAWLASER1 {HEADER} 2 1.0 2.0 0 1.0 host 0.1",
            f"ROBOTLASER1 {HEADER} 2 1.0 2.0 0 {tail} 1.01 host 0.1",
            f"RAWLASER2 {HEADER} 2 3.0 4.0 0 1.0 host 0.1",
            f"RAWLASER1 {HEADER} 3 1.0 2.0 0 1.0 host 0.1",  # damaged, but not used either
        ]
    )
    assert [s.name for s in recording.source.sensors] == ["RAWLASER2", "ROBOTLASER1"]
    assert recording.n_scans == 2
    assert "RAWLASER1: 1 scans not used" in recording.source.duplicates[0]
    assert recording.source.skipped == {}


def test_constant_scan_poses_are_ignored(read_log, flaser):
    recording = read_log(
        ["ODOM 1 0 0 0 0 0 1.0 host 0", flaser(1.5), flaser(2.0), "ODOM 3 0 0 0 0 0 2.0 host 0"]
    )
    np.testing.assert_allclose(se2.parameters(recording.T_odom_base)[:, 0], [2.0, 3.0])
    assert recording.source.odometry["from"] == "ODOM lines"


def test_old_and_new_number_formats(read_log):
    recording = read_log(
        b"\xef\xbb\xbfFLASER 2 +1 2e-1 0 0 0 0 0 0 1.5e+09\r\n"
        b"FLASER 2 1 1E0 0 0 0 0 0 0 1500000000.25 host\r\n"
        b"FLASER 2 nan inf 0 0 0 1e-3 0 0 +1500000000.500000001 h 3\r\n"
    )
    second = 1_500_000_000 * 10**9
    assert recording.stamp_ns.tolist() == [second, second + 250_000_000, second + 500_000_001]
    np.testing.assert_allclose(np.linalg.norm(recording.points[:4], axis=1), [1, 0.2, 1, 1])
    assert np.isnan(recording.points[4]).all()
    assert recording.hit.tolist() == [True] * 4 + [False] * 2
    assert np.isfinite(recording.points[5]).all(), "+inf is maximum range"
    assert recording.source.skipped == {}


def test_host_may_be_a_number(read_log):
    recording = read_log([f"FLASER 2 1 2 0 0 0 0 0 0 {stamp} 10 0.5" for stamp in range(3)])
    assert recording.n_scans == 3


def test_gzip_is_detected_by_content(log, flaser):
    text = "".join(f"{flaser(i)}\n" for i in range(5)).encode()
    plain = read(log(text, "a.log"))
    packed = read(log(gzip.compress(text), "packed.log"))  # the name does not matter
    unpacked = read(log(text, "unpacked.clf.gz"))
    np.testing.assert_array_equal(plain.points, packed.points)
    np.testing.assert_array_equal(plain.points, unpacked.points)


def test_unknown_kinds_are_counted(read_log, flaser):
    recording = read_log(["SYNC now", "SONAR 1 2 3", "SONAR 3", "", flaser(1.0)])
    assert recording.source.ignored == {"SYNC": 1, "SONAR": 2}
    assert recording.source.skipped == {}


@pytest.mark.parametrize("kind", ["RAWLASER1", "ROBOTLASER1"])
def test_header_without_angles(read_log, kind):
    tail = "0" if kind == "RAWLASER1" else "0 0 0 0 0 0 0 0 0 0 0 0"
    header = "0 nan 3.14 0.01 20 0.01 0"
    with pytest.raises(InputError, match="line that cannot be read"):
        read_log([f"{kind} {header} 2 1 2 {tail} 1.0 host 0.1"])
