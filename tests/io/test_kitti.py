"""KITTI: odometry sequences and raw drives, whole and damaged."""

import os

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.io import read
from stillmap.io.text_lines import assign_rows, read_times

# the laser's x is the camera's z: a rotation, and a place
TR = "0 -1 0 0.1 0 0 -1 -0.2 1 0 0 -0.3"
T_CAMERA_LASER = np.vstack([np.array(TR.split(), float).reshape(3, 4), [0, 0, 0, 1]])
P2 = "700 0 600 70 0 700 170 0 0 0 1 0"


def sweep(n=5, value=1.0):
    rows = np.zeros((n, 4), "<f4")
    rows[:, 0] = value + np.arange(n)
    rows[:, 3] = 0.5
    return rows.tobytes()


@pytest.fixture
def folder(tmp_path):
    """Three sweeps, with times alone."""
    (tmp_path / "velodyne").mkdir()
    for i in range(3):
        (tmp_path / "velodyne" / f"{i:06d}.bin").write_bytes(sweep(4 + i, 1 + i))
    (tmp_path / "times.txt").write_text("0.000000e+00\n1.037359e-01\n2.0703511e-01\n")
    return tmp_path


def test_sweeps_and_times_are_enough(folder):
    found = read(folder)
    assert (found.n_scans, found.dimension) == (3, 3)
    np.testing.assert_array_equal(found.stamp_ns, [0, 103_735_900, 207_035_110])
    np.testing.assert_array_equal(np.diff(found.offset), [4, 5, 6])
    np.testing.assert_array_equal(found.points[:4, 0], [1, 2, 3, 4])
    assert found.T_recorded_base is None
    assert found.images is None
    assert found.beam_time is None
    assert found.source.warnings == []


def test_poses_of_the_camera_become_those_of_the_laser(folder):
    (folder / "calib.txt").write_text(f"P2: {P2}\nTr: {TR}\n")
    # 2 m ahead, which is the camera's z, and turned left, which is about its -y
    R = Rotation.from_euler("y", -0.5).as_matrix()
    rows = [np.eye(4)[:3], np.column_stack([R, [0, 0, 2]]), np.column_stack([R, [0, 0, 4]])]
    np.savetxt(folder / "poses.txt", np.reshape(rows, (3, 12)))
    T = read(folder).T_recorded_base
    np.testing.assert_allclose(T[0], np.eye(4), atol=1e-12)
    np.testing.assert_allclose(T[1, :3, :3], Rotation.from_euler("z", 0.5).as_matrix(), atol=1e-9)
    np.testing.assert_allclose((T[2] - T[1])[:3, 3], [2, 0, 0], atol=1e-9)
    # where the camera is in the map of the first laser
    camera = T[1] @ se2.inverse(T_CAMERA_LASER)
    first = se2.inverse(T_CAMERA_LASER)
    np.testing.assert_allclose(camera[:3, 3] - first[:3, 3], [2, 0, 0], atol=1e-9)


@pytest.mark.parametrize(
    ("files", "what"),
    [
        ({"poses.txt": "1 0 0 0 0 1 0 0 0 0 1 0\n" * 3}, "no calib.txt"),
        ({"poses_lidar.txt": "1 0 0 0 0 1 0 0 0 0 1 0\n" * 2}, "has 2 for 3"),
        ({"poses_lidar.txt": "1 0 0 0 0 1 0 0 0 0 1\n" * 3}, "is damaged"),
        (
            {"poses_lidar.txt": "1 0 0 0 0 1 0 0 0 0 1 0\n2 0 0 0 0 1 0 0 0 0 1 0\n"},
            "no rotation matrix",
        ),
        ({"poses_lidar.txt": "1 0 0 nan 0 1 0 0 0 0 1 0\n" * 3}, "not finite"),
        ({"calib.txt": "Tr: 1 2 3\n"}, "calibration is ignored"),
    ],
)
def test_poses_that_cannot_be_used_cost_the_poses(folder, files, what):
    for name, text in files.items():
        (folder / name).write_text(text)
    found = read(folder)
    assert found.T_recorded_base is None
    assert found.n_scans == 3
    assert any(what in warning for warning in found.source.warnings), found.source.warnings


def test_pictures(folder):
    (folder / "calib.txt").write_text(f"P2: {P2}\nTr: {TR}\n")
    (folder / "image_2").mkdir()
    for i in range(3):
        picture = np.full((6, 8, 3), (10 * i, 20, 30), np.uint8)
        Image.fromarray(picture).save(folder / "image_2" / f"{i:06d}.png")
    found = read(folder)
    images = found.images
    (camera,) = images.cameras
    assert (camera.name, camera.width, camera.height) == ("image_2", 8, 6)
    np.testing.assert_array_equal(images.stamp_ns, found.stamp_ns)
    np.testing.assert_array_equal(images.read(2)[0, 0], [20, 20, 30])
    # P2 (Tr X) and K (T_camera_base X) see a point of the laser at the same pixel
    X = np.array([10.0, 2.0, 1.0, 1.0])
    pixel = np.array(P2.split(), float).reshape(3, 4) @ T_CAMERA_LASER @ X
    seen = camera.K @ (se2.inverse(camera.T_base_camera) @ X)[:3]
    np.testing.assert_allclose(seen[:2] / seen[2], pixel[:2] / pixel[2])
    (folder / "image_2" / "000001.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match="no image"):
        read(folder).images.read(1)


def test_a_raw_drive(tmp_path):
    drive = tmp_path / "2011_09_26" / "2011_09_26_drive_0001_sync"
    sweeps = drive / "velodyne_points" / "data"
    sweeps.mkdir(parents=True)
    for i in (0, 2):  # sweep 1 is missing, as in some drives
        (sweeps / f"{i:010d}.bin").write_bytes(sweep())
    dates = ["25.951199337", "26.054663000", "26.1"]
    text = "".join(f"2011-09-26 13:02:{second}\n" for second in dates)
    (drive / "velodyne_points" / "timestamps.txt").write_text(text)
    (drive / "oxts" / "data").mkdir(parents=True)
    for i in range(3):
        # north by 1e-5 degrees from line to line, facing north
        line = f"{49.0 + i * 1e-5:.12f} 8.0 100.0 0 0 {np.pi / 2:.15f} 1 2 3"
        (drive / "oxts" / "data" / f"{i:010d}.txt").write_text(line)
    (drive / "image_02" / "data").mkdir(parents=True)
    Image.fromarray(np.zeros((4, 5), np.uint8)).save(drive / "image_02/data/0000000000.png")
    (drive / "image_02" / "timestamps.txt").write_text("2011-09-26 13:02:25.96\n")
    above = drive.parent
    (above / "calib_velo_to_cam.txt").write_text(
        "calib_time: 15-Mar-2012\nR: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 0\n"
    )
    (above / "calib_cam_to_cam.txt").write_text(f"R_rect_00: 1 0 0 0 1 0 0 0 1\nP_rect_02: {P2}\n")
    (above / "calib_imu_to_velo.txt").write_text("R: 1 0 0 0 1 0 0 0 1\nT: -0.8 0.3 -0.8\n")
    found = read(drive)
    assert found.stamp_ns.tolist() == [1_317_042_145_951_199_337, 1_317_042_146_100_000_000]
    # the laser is 0.8 m ahead of the unit and faces north: y; two lines of 1.11 m lie between
    T = found.T_recorded_base
    np.testing.assert_allclose(T[0, :3, 3], [0.3, 0.8, 0.8], atol=1e-9)
    step = 2e-5 * np.pi / 180 * 6378137.0
    np.testing.assert_allclose(T[1, :3, 3] - T[0, :3, 3], [0, step, 0], atol=1e-5)
    np.testing.assert_allclose(T[0, :3, 0], [0, 1, 0], atol=1e-9)
    assert found.images.stamp_ns.tolist() == [1_317_042_145_960_000_000]
    assert found.images.cameras[0].K[0, 0] == 700
    assert found.images.read(0).shape == (4, 5)


def test_damaged_sweeps_are_skipped_and_counted(folder):
    sweeps = folder / "velodyne"
    (sweeps / "000001.bin").write_bytes(sweep()[:-3])
    (sweeps / "000003.bin").write_bytes(b"")
    (sweeps / "000004.bin").symlink_to("nowhere.bin")
    (sweeps / "000005.bin").symlink_to("000000.bin")
    os.mkfifo(sweeps / "000006.bin")
    (sweeps / "000007.bin").write_bytes(sweep())
    (sweeps / ".hidden.bin").write_bytes(sweep())
    (folder / "times.txt").write_text("".join(f"{i}\n" for i in range(4)) + "x\n5\n6\n")
    found = read(folder)
    assert found.stamp_ns.tolist() == [0, 2 * 10**9, 5 * 10**9]
    skipped = {reason: damage.lines for reason, damage in found.source.skipped.items()}
    assert skipped == {
        "is truncated": [2],
        "is empty": [4],
        "has no stamp": [5, 8],
        "is no regular file": [7],
    }
    assert "skipped 5 of 8: 000001.bin" in found.source.warnings[-1]


def test_points_that_are_not_finite_or_absurd_are_unusable(folder):
    rows = np.ones((5, 4), "<f4")
    rows[1, 0], rows[2, 1], rows[3, 2], rows[4, :3] = np.nan, np.inf, 1e30, 0.0
    (folder / "velodyne" / "000000.bin").write_bytes(rows.tobytes())
    found = read(folder)
    np.testing.assert_array_equal(found.hit[:5], [True, False, False, False, False])
    assert np.isnan(found.points[1:5]).all()


def test_nothing_that_can_be_read(folder):
    for file in (folder / "velodyne").iterdir():
        file.write_bytes(b"")
    with pytest.raises(InputError, match=r"no usable scan: 3 x is empty \(file 1, 2, 3\)"):
        read(folder)
    for file in (folder / "velodyne").iterdir():
        file.unlink()
    with pytest.raises(InputError, match="no scan"):
        read(folder)
    (folder / "times.txt").unlink()
    (folder / "velodyne" / "0.bin").write_bytes(sweep())
    with pytest.raises(InputError, match=r"times\.txt: does not exist"):
        read(folder)


def test_which_time_is_whose(tmp_path):
    def rows(names, n):
        return assign_rows([tmp_path / f"{name}.bin" for name in names], n, tmp_path)

    assert rows(["000000", "000001"], 2) == [0, 1]
    assert rows(["000000", "000002"], 3) == [0, 2]
    assert rows(["000000", "000001", "000002"], 2) == [0, 1, None]
    assert rows(["000100", "000101"], 2) == [0, 1]  # a piece of a longer drive
    assert rows(["a", "b"], 2) == [0, 1]
    for names, n in ((["a", "b"], 3), (["000100", "000101"], 3), (["a"], 0)):
        with pytest.raises(InputError, match=f"has {n} stamps for {len(names)} files"):
            rows(names, n)


def test_times(tmp_path):
    file = tmp_path / "times.txt"
    file.write_text("0.1\n\n2011-09-26 13:02:25.000000001\n2011-13-26 13:02:25\n1e400\n-1.5\n\n \n")
    assert read_times(file) == [10**8, None, 1_317_042_145_000_000_001, None, None, -1_500_000_000]
    last = "2116-02-20 23:53:38"
    file.write_text(f"1969-12-31 23:59:58.25\n{last}.5\n{last}.427387903\n")
    assert read_times(file) == [-1_750_000_000, None, 2**62 - 1]
