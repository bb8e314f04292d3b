"""Folders of RGB-D cameras, whole and damaged."""

import shutil
import struct
import zlib

import numpy as np
import pytest
from peak_memory import READ, run_measured
from PIL import Image
from scipy.spatial.transform import Rotation

from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.core.source import SensorNotes, Skipped
from stillmap.io import read, rgbd
from stillmap.io.rgbd import T_BASE_CAMERA
from stillmap.prepare import prepare
from stillmap.prepare.options import ReadOptions

W, H = 64, 48
K = np.array([[60.0, 0.0, 31.5], [0.0, 58.0, 23.5], [0.0, 0.0, 1.0]])
ROOM = (np.array([-3.0, -2.0, 0.0]), np.array([3.0, 2.0, 2.4]))  # m, its corners
# the world of recorded poses, as it lies to one whose z is up
T_WORLD_ROOM = np.eye(4)
T_WORLD_ROOM[:3, :3] = Rotation.from_euler("xyz", [70.0, 25.0, 130.0], degrees=True).as_matrix()
T_WORLD_ROOM[:3, 3] = (5.0, -7.0, 2.0)


def way(n: int) -> np.ndarray:
    """(n, 4, 4) T_room_camera of one who looks around, and mostly down a little."""
    T = np.tile(np.eye(4), (n, 1, 1))
    k = np.arange(n)
    angles = np.column_stack([25.0 * k, 15.0 + 8.0 * np.sin(k), 4.0 * np.cos(2.0 * k)])
    T[:, :3, :3] = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()
    T[:, :3, 3] = np.column_stack([0.3 * np.cos(k), 0.2 * np.sin(k), 1.5 + 0.05 * np.sin(3.0 * k)])
    return T @ T_BASE_CAMERA


def depth_of(T: np.ndarray, scale: float) -> np.ndarray:
    """(H, W) uint16 depth of the room's walls from a pose."""
    columns, rows = np.meshgrid(np.arange(W), np.arange(H))
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(K).T
    rays = rays @ T[:3, :3].T
    with np.errstate(divide="ignore"):
        to_walls = np.stack([(corner - T[:3, 3]) / rays for corner in ROOM])
    return np.round(scale * np.where(to_walls > 0.0, to_walls, np.inf).min(axis=(0, 3)))


def write_scenes(folder, n=8, numbers=None, intrinsics=True):
    folder.mkdir(exist_ok=True)
    for number, T in zip(numbers or [8 * k for k in range(n)], way(n), strict=True):
        name = folder / f"frame-{number:06d}"
        Image.fromarray(depth_of(T, 1000.0).astype(np.uint16)).save(f"{name}.depth.png")
        Image.fromarray(np.full((H, W, 3), number, np.uint8)).save(f"{name}.color.png")
        np.savetxt(f"{name}.pose.txt", T_WORLD_ROOM @ T)
    if intrinsics:
        np.savetxt(folder / "camera-intrinsics.txt", K)
    return folder


def write_tum(folder, n=8):
    (folder / "depth").mkdir(parents=True)
    (folder / "rgb").mkdir()
    lists = {name: f"# {name} maps\n# timestamp filename\n" for name in ("depth", "rgb")}
    truth = "# ground truth\n"
    for k, T in enumerate(way(n)):
        stamp = 1305031102.16 + 0.0333 * k
        Image.fromarray(depth_of(T, 5000.0).astype(np.uint16)).save(folder / f"depth/{k}.png")
        Image.fromarray(np.full((H, W, 3), k, np.uint8)).save(folder / f"rgb/{k}.png")
        lists["depth"] += f"{stamp:.6f} depth/{k}.png\n"
        lists["rgb"] += f"{stamp + 0.01:.6f} rgb/{k}.png\n"
        world = T_WORLD_ROOM @ T
        numbers = [*world[:3, 3], *Rotation.from_matrix(world[:3, :3]).as_quat()]
        truth += f"{stamp:.6f} {' '.join(f'{v:.9f}' for v in numbers)}\n"
    for name, text in lists.items():
        (folder / f"{name}.txt").write_text(text)
    (folder / "groundtruth.txt").write_text(truth)
    np.savetxt(folder / "camera-intrinsics.txt", K)
    return folder


@pytest.fixture
def scenes(tmp_path):
    return write_scenes(tmp_path / "seq-01")


def assert_on_the_walls(recording: Recording, within: float) -> None:
    """All end points, by the recorded poses, lie on walls of a room that is level."""
    ends = recording.end_points(np.flatnonzero(recording.hit), recording.T_recorded_base)
    height = ends[:, 2]
    assert np.abs(height - height.min()).min() == 0.0
    floor, ceiling = height.min(), height.max()
    assert ceiling - floor == pytest.approx(2.4, abs=2.0 * within)
    on_level = (np.abs(height - floor) < within) | (np.abs(height - ceiling) < within)
    assert 0.1 < on_level.mean() < 0.9
    # the others stand on four planes across: their directions in the plan are two
    walls = ends[~on_level][:, :2]
    assert len(np.unique(np.round(walls / 0.05), axis=0)) < 0.1 * len(walls)


@pytest.fixture
def no_alignment(monkeypatch):
    monkeypatch.setattr(prepare, "align_to_gravity", lambda recording: recording)


@pytest.mark.usefixtures("no_alignment")
def test_every_depth_picture_is_a_grid_of_beams(scenes):
    found = read(scenes, ReadOptions(depth_step=1))
    assert (found.n_scans, found.dimension) == (8, 3)
    np.testing.assert_array_equal(np.diff(found.offset), W * H)
    np.testing.assert_array_equal(found.stamp_ns, np.round(8e9 / 30 * np.arange(8)))
    assert found.source.sensors == [SensorNotes("depth", grid=(H, W))]
    assert found.source.format == "7-Scenes"
    assert "30 per second" in found.source.warnings[0]
    # x ahead is the depth; the pixel in row 40, column 10 looks to the left, and down
    point = found.points.reshape(8, H, W, 3)[3, 40, 10]
    depth = depth_of(way(8)[3], 1000.0)[40, 10] / 1000.0
    expected = [depth, -(10 - 31.5) / 60.0 * depth, -(40 - 23.5) / 58.0 * depth]
    np.testing.assert_allclose(point, expected, rtol=1e-6)
    np.testing.assert_array_equal(found.T_base_sensor, np.eye(4)[None])
    expected = T_WORLD_ROOM @ way(8) @ se2.inverse(T_BASE_CAMERA)
    np.testing.assert_allclose(found.T_recorded_base, expected, atol=1e-9)


def test_unusable_pixels_keep_their_place(scenes):
    depth = depth_of(way(8)[0], 1000.0).astype(np.uint16)
    depth[4, 6], depth[4, 8] = 0, 65535
    Image.fromarray(depth).save(scenes / "frame-000000.depth.png")
    found = read(scenes)
    grid = found.points.reshape(8, H // 2, W // 2, 3)
    assert np.isnan(grid[0, 2, [3, 4]]).all()
    assert np.isfinite(grid[0]).sum() == 3 * (H * W // 4 - 2)
    assert found.source.sensors[0].grid == (H // 2, W // 2)


def test_the_world_is_turned_so_that_z_is_up(scenes):
    found = read(scenes)
    assert found.source.details["levelled"]["by"] == "plane"
    assert_on_the_walls(found, 0.02)
    up = T_WORLD_ROOM[:3, 2]
    np.testing.assert_allclose(found.source.details["levelled"]["up"], up, atol=2e-3)
    angle = np.degrees(np.arccos(up[2]))
    assert found.source.details["levelled"]["turned_deg"] == pytest.approx(angle, abs=0.2)


def test_without_level_surfaces_the_cameras_tell(tmp_path):
    folder = write_scenes(tmp_path / "walls")
    for k, T in enumerate(way(8)):
        columns, rows = np.meshgrid(np.arange(W), np.arange(H))
        rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(K).T
        aside = np.linalg.norm((rays @ T[:3, :3].T)[..., :2], axis=-1)  # within a round tower
        depth = np.round(2000.0 / aside).astype(np.uint16)
        Image.fromarray(depth).save(folder / f"frame-{8 * k:06d}.depth.png")
    found = read(folder)
    assert found.source.details["levelled"]["by"] == "cameras"
    # who looks down and around does not tilt on the whole
    np.testing.assert_allclose(
        found.source.details["levelled"]["up"], T_WORLD_ROOM[:3, 2], atol=0.2
    )


def test_cameras_that_point_anywhere_tell_nothing(scenes):
    turns = Rotation.from_rotvec(np.outer(np.arange(8) * np.pi / 2, [0, 0, 1])).as_matrix()
    for k, R in enumerate(turns):
        T = np.eye(4)
        T[:3, :3] = R
        np.savetxt(scenes / f"frame-{8 * k:06d}.pose.txt", T)
    found = read(scenes)
    assert "arbitrary orientations" in found.source.details["levelled"]["by"]
    base = np.eye(4)
    np.testing.assert_allclose(
        found.T_recorded_base[0], base @ se2.inverse(T_BASE_CAMERA), atol=1e-12
    )


def test_colour_pictures_come_with_their_camera(scenes):
    (scenes / "frame-000016.color.png").unlink()
    found = read(scenes)
    (camera,) = found.images.cameras
    assert (camera.name, camera.width, camera.height) == ("color", W, H)
    np.testing.assert_array_equal(camera.K, K)
    np.testing.assert_array_equal(camera.T_base_camera, T_BASE_CAMERA)
    np.testing.assert_array_equal(found.images.stamp_ns, found.stamp_ns[[0, 1, 3, 4, 5, 6, 7]])
    np.testing.assert_array_equal(found.images.read(2)[0, 0], [24, 24, 24])


def test_colour_of_another_size_is_not_calibrated(scenes):
    for file in scenes.glob("*.color.png"):
        Image.fromarray(np.zeros((2 * H, 2 * W, 3), np.uint8)).save(file)
    found = read(scenes)
    assert found.images.cameras[0].K is None
    assert any("calibration by read.cameras" in warning for warning in found.source.warnings)


@pytest.mark.parametrize("place", ["seq-01/camera.txt", "camera-intrinsics.txt", None])
def test_where_intrinsics_are_found(tmp_path, place):
    folder = write_scenes(tmp_path / "seq-01", n=2, intrinsics=False)
    if place is not None:
        np.savetxt(tmp_path / place, K)
    found = read(folder)
    expected = K if place else np.array([[585, 0, 320], [0, 585, 240], [0, 0, 1]])
    np.testing.assert_array_equal(found.images.cameras[0].K, expected)
    said = any("no calibration of the depth camera" in w for w in found.source.warnings)
    assert said == (place is None)


@pytest.mark.parametrize("text", ["1 2 3", "nan " * 9, "0 " * 9, "x", "\0" * 20])
def test_intrinsics_that_are_none(scenes, text):
    (scenes / "camera-intrinsics.txt").write_text(text)
    found = read(scenes)
    assert any("camera-intrinsics.txt is not used" in w for w in found.source.warnings)
    assert found.images.cameras[0].K[0, 0] == 585.0


def test_far_readings_show_free_space(scenes, monkeypatch):
    monkeypatch.setattr(rgbd, "_MAX_DEPTH", 2.5)
    found = read(scenes, ReadOptions())
    length = np.linalg.norm(found.points, axis=1)
    assert length.max() == pytest.approx(2.5)
    assert 0.1 < found.hit.mean() < 0.9
    np.testing.assert_array_equal(found.hit, length < 2.5 - 1e-5)
    # --max-range goes first
    assert read(scenes, ReadOptions(max_range=9.0)).hit.all()
    metres = read(scenes, ReadOptions(max_range=9.0)).points[0, 0]
    halved = read(scenes, ReadOptions(max_range=9.0, depth_scale=2000.0)).points[0, 0]
    assert halved == pytest.approx(metres / 2)


LOST = ["nan " * 16, "-inf " * 16, "1 0 0", "", "2 0 0 0 " * 4, "word"]


@pytest.mark.parametrize("text", LOST)
def test_pictures_without_a_pose_are_skipped_where_most_have_one(scenes, text):
    (scenes / "frame-000008.pose.txt").write_text(text)
    (scenes / "frame-000024.pose.txt").unlink()
    found = read(scenes)
    assert found.source.skipped == {"has no pose, as most others have": Skipped(2, [2, 4])}
    assert found.n_scans == len(found.T_recorded_base) == 6
    for file in scenes.glob("*.pose.txt"):
        file.unlink()
    found = read(scenes)
    assert (found.n_scans, found.T_recorded_base) == (8, None)


def test_damaged_pictures_are_skipped(scenes):
    (scenes / "frame-000000.depth.png").write_bytes(b"no picture")
    Image.fromarray(np.zeros((H, W), np.uint16)).save(scenes / "frame-000008.depth.png")
    Image.fromarray(np.zeros((H, W), np.uint8)).save(scenes / "frame-000016.depth.png")
    Image.fromarray(np.ones((H, 2 * W), np.uint16)).save(scenes / "frame-000024.depth.png")
    whole = (scenes / "frame-000032.depth.png").read_bytes()
    (scenes / "frame-000032.depth.png").write_bytes(whole[: len(whole) // 2])
    found = read(scenes)
    assert found.n_scans == 3
    reasons = set(found.source.skipped)
    assert {
        "holds no depth",
        "is of another size than the first",
        "is no image, or damaged",
    } < reasons
    assert "is no depth image" in reasons


def test_nothing_but_damage_is_an_error(scenes):
    for file in scenes.glob("*.depth.png"):
        file.write_bytes(b"no picture")
    with pytest.raises(InputError, match=r"frame-000000\.depth\.png: is no image"):
        read(scenes)
    for file in scenes.glob("*.depth.png"):
        Image.fromarray(np.zeros((H, W), np.uint16)).save(file)
    with pytest.raises(InputError, match=r"holds no usable scan: 8 x holds no depth"):
        read(scenes)


def test_a_camera_file_says_how_depth_is_seen(scenes, tmp_path):
    plain = read(scenes, ReadOptions(depth_step=1)).points.reshape(8, H, W, 3)
    file = tmp_path / "cameras.toml"
    file.write_text("[color]\nfx = 120.0\nfy = 116.0\ncx = 31.5\ncy = 23.5\n")
    found = read(scenes, ReadOptions(depth_step=1, cameras=str(file)))
    half = found.points.reshape(8, H, W, 3)
    np.testing.assert_allclose(half, plain * [1.0, 0.5, 0.5], rtol=1e-5, atol=1e-6)
    assert found.images.cameras[0].K[0, 0] == 120.0
    # of depth alone, which has no pictures of colours
    file.write_text(file.read_text().replace("[color]", "[depth]"))
    found = read(scenes, ReadOptions(depth_step=1, cameras=str(file)))
    np.testing.assert_array_equal(found.points.reshape(half.shape), half)
    file.write_text("[dept]\nfx = 3\n")
    with pytest.raises(InputError, match=r"no camera 'dept' \(has: depth"):
        read(scenes, ReadOptions(cameras=str(file)))
    file.write_text("[depth]\nwidth = 5\nheight = 7\n")
    with pytest.raises(InputError, match="the size given for 'depth' differs"):
        read(scenes, ReadOptions(cameras=str(file)))


def test_tum(tmp_path):
    found = read(write_tum(tmp_path / "fr1"))
    assert found.source.format == "TUM RGB-D"
    assert found.stamp_ns[0] == 1305031102_160000000
    assert found.n_scans == 8
    assert_on_the_walls(found, 0.02)
    np.testing.assert_array_equal(found.images.stamp_ns, found.stamp_ns + 10_000_000)
    np.testing.assert_array_equal(found.images.read(3)[0, 0], [3, 3, 3])


@pytest.mark.usefixtures("no_alignment")
def test_tum_poses_between_those_that_are_known(tmp_path):
    folder = write_tum(tmp_path / "fr1")
    whole = read(folder)
    lines = (folder / "groundtruth.txt").read_text().splitlines()
    del lines[3]  # of the third picture
    lines = [lines[0], *reversed(lines[1:])]
    (folder / "groundtruth.txt").write_text("\n".join(lines))
    found = read(folder)
    np.testing.assert_array_equal(found.T_recorded_base[3:], whole.T_recorded_base[3:])
    middle = 0.5 * (whole.T_recorded_base[1] + whole.T_recorded_base[3])[:3, 3]
    np.testing.assert_allclose(found.T_recorded_base[2, :3, 3], middle, atol=0.05)
    # far from any pose there is none
    (folder / "groundtruth.txt").write_text("\n".join(lines[:-5]))
    found = read(folder)
    assert found.source.skipped["has no pose, as most others have"].count == 3
    (folder / "groundtruth.txt").write_text("1 2 3\n")
    found = read(folder)
    assert found.T_recorded_base is None
    assert any("poses are not used" in warning for warning in found.source.warnings)


def test_tum_lists_lead_nowhere_else(tmp_path):
    folder = write_tum(tmp_path / "fr1")
    shutil.copy(folder / "depth" / "0.png", tmp_path / "outside.png")
    outside = ("../outside.png", str(tmp_path / "outside.png"), "depth/\0.png", "", "depth/0.png 7")
    text = "".join(f"{9 + k} {name}\n" for k, name in enumerate(outside))
    (folder / "depth.txt").write_text(text + "x depth/1.png\n1305031102.5 depth/1.png\n")
    found = read(folder)
    assert found.n_scans == 1
    assert any("depth.txt: 6 lines" in warning for warning in found.source.warnings)
    (folder / "depth.txt").write_text("# nothing\n")
    with pytest.raises(InputError, match="lists no image"):
        read(folder)


def test_a_header_that_claims_many_pixels_costs_little(scenes):
    """The rays of all pixels follow from it; they are computed some at a time."""
    for file in scenes.glob("*.depth.png"):
        content = bytearray(file.read_bytes())
        content[16:24] = struct.pack(">II", 8192, 8191)
        content[29:33] = struct.pack(">I", zlib.crc32(content[12:29]))
        file.write_bytes(content)
    said, megabytes = run_measured(READ, scenes)
    assert "holds no usable scan" in said[0]
    assert megabytes < 700
