"""Seeds of fuzzing: small valid recordings of every format."""

import gzip
import io
import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import lzf
import numpy as np
import pye57
from parts import join_parts
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from cut_recordings import N, make_recording

from stillmap.core.arrays import write_npz
from stillmap.core.camera import Camera, Images
from stillmap.core.config import to_toml
from stillmap.core.recording import Recording
from stillmap.io import stillmap_folder, writers
from stillmap.io.point_cloud.las import make_header
from stillmap.io.trajectory import write_tum
from stillmap.pipeline.options import Options

START = 1_600_000_000_000_000_000


def recording_2d(scans: int = 6) -> Recording:
    """A robot with a laser on a slightly curved path."""
    return make_recording(2, scans)


def recording_3d() -> Recording:
    """A 3D recording of three scans with poses, beam times and images."""
    recording = make_recording(3, 3)
    pictures = [np.full((4, 6, 3), 50 * k, np.uint8) for k in range(2)]
    camera = Camera("cam", 6, 4, np.diag([4.0, 4.0, 1.0]), "plumb_bob", np.zeros(5), np.eye(4))
    stamps, first = START + np.arange(2, dtype=np.int64), np.zeros(2, np.int32)
    return replace(
        recording,
        T_recorded_base=recording.T_odom_base,
        beam_time=np.tile(np.linspace(0, 0.09, N, dtype=np.float32), 3),
        images=Images(stamps, first, (camera,), pictures.__getitem__),
    )


def read_files(place: Path, names: tuple[str, ...]) -> bytes:
    """The files of a folder in the order of `names`; empty where one is missing."""
    files = [place / name for name in names]
    return join_parts([file.read_bytes() if file.is_file() else b"" for file in files])


def carmen(work: Path) -> Iterator[bytes]:
    writers.write(recording_2d(), work / "a.log")
    log = (work / "a.log").read_bytes()
    yield log
    yield gzip.compress(log)
    header, poses = "0 -1.570796 3.141593 0.3926991 20.0 0.01 0", "0.1 0 0 0 0 0"
    lines = ["PARAM robot_frontlaser_offset 0.1", "PARAM robot_front_laser_max 20.0"]
    for t in range(4):
        stamp, ranges = f"{t}.5 host {t}.6", "1.0 2.5 81.83"
        lines += [
            f"ODOM {t} 0 0 0 0 0 {stamp}",
            f"RAWLASER2 {header} 3 {ranges} 1 4 {stamp}",
            f"ROBOTLASER1 {header} 3 {ranges} 0 {poses} 0 0 0 0 0 {stamp}",
            f"RLASER 3 {ranges} {poses} {stamp}",
        ]
    yield "".join(f"{line}\n" for line in lines).encode()


STILLMAP = (
    *("recording.json", "stamp_ns.npy", "offset.npy", "points.npy", "hit.npy"),
    *("T_base_sensor.npy", "sensor.npy", "T_odom_base.npy", "beam_time.npy", "T_recorded_base.npy"),
    *("image_stamp_ns.npy", "image_camera.npy", "images/000000.png", "images/000001.npy"),
)


def stillmap(work: Path) -> Iterator[bytes]:
    for name, recording in (("flat", recording_2d()), ("space", recording_3d())):
        stillmap_folder.write(recording, work / name)
        yield read_files(work / name, STILLMAP)


KITTI = (
    *("times.txt", "calib.txt", "poses.txt", "poses_lidar.txt"),
    *("velodyne/000000.bin", "velodyne/000001.bin", "velodyne/000002.bin"),
    *("image_2/000000.png", "image_2/000001.png", "image_2/000002.png"),
)
DRIVE = (
    *("velodyne_points/timestamps.txt", "calib_velo_to_cam.txt", "calib_cam_to_cam.txt"),
    *("calib_imu_to_velo.txt", "oxts/data/0.txt", "oxts/data/1.txt", "image_02/timestamps.txt"),
    *("velodyne_points/data/0.bin", "velodyne_points/data/1.bin", "image_02/data/0.png"),
)


def kitti(work: Path) -> Iterator[bytes]:
    writers.write(recording_3d(), work / "k", name="kitti")
    (work / "k" / "image_2").mkdir()
    for k in range(3):
        Image.new("L", (4, 3), 60 * k).save(work / "k" / "image_2" / f"{k:06d}.png")
    row = "1 0 0 0 0 1 0 0 0 0 1 0"
    (work / "k" / "calib.txt").write_text(f"P0: {row}\nP2: {row}\nTr: {row}\n")
    yield read_files(work / "k", KITTI)


def drive(work: Path) -> Iterator[bytes]:  # noqa: ARG001
    R, P = "R: 1 0 0 0 1 0 0 0 1", "P_rect_02: 1 0 0 0 0 1 0 0 0 0 1 0"
    times = "2011-09-26 13:02:25.594360375\n2011-09-26 13:02:25.697360375\n"
    placed = f"{R}\nT: 0 0 0.1\n".encode()
    cameras = f"R_rect_00: {R[3:]}\n{P}\n".encode()
    where = b"49.0 8.4 112.8 0.02 0.00001 -1.2 0 0 0\n"
    sweep = np.random.default_rng(4).normal(0, 5, (6, 4)).astype("<f4").tobytes()
    out = io.BytesIO()
    Image.new("L", (4, 3)).save(out, format="PNG")
    yield join_parts(
        [
            *(times.encode(), placed, cameras, placed, where, where, times.encode()[:30]),
            *(sweep, sweep, out.getvalue()),
        ]
    )


def pcd(work: Path) -> Iterator[bytes]:
    writers.write(recording_3d(), work / "p", name="pcd")
    binary = next((work / "p").glob("*.pcd")).read_bytes()
    yield binary
    at = binary.find(b"DATA binary\n")
    body = binary[at + 12 :]
    columns = np.frombuffer(body, "<f4").reshape(-1, 4).T.tobytes()
    packed = lzf.compress(columns, 2 * len(columns))
    sizes = len(packed).to_bytes(4, "little") + len(columns).to_bytes(4, "little")
    yield binary[:at] + b"DATA binary_compressed\n" + sizes + packed
    rows = np.frombuffer(body, "<f4").reshape(-1, 4)
    text = "".join(" ".join(str(v) for v in row) + "\n" for row in rows.tolist())
    yield binary[:at] + b"DATA ascii\n" + text.encode()


def ply(work: Path) -> Iterator[bytes]:
    writers.write(recording_3d(), work / "a.ply")
    yield (work / "a.ply").read_bytes()
    yield (
        b"ply\nformat ascii 1.0\nelement camera 1\nproperty short a\nelement vertex 2\n"
        b"property float x\nproperty float y\nproperty float z\nelement face 1\n"
        b"property list uchar int v\nend_header\n7\n1 2 3\n4 5 6\n1 1\n"
    )
    rows = np.arange(6, dtype=">f4").tobytes()
    yield (
        b"ply\nformat binary_big_endian 1.0\nelement vertex 2\nproperty float x\n"
        b"property float y\nproperty float z\nend_header\n" + rows
    )


def las(work: Path) -> Iterator[bytes]:
    for name in ("a.las", "a.laz"):
        writers.write(recording_3d(), work / name)
        yield (work / name).read_bytes()
    import laspy

    # a later version, with another point format
    head = laspy.LasHeader(point_format=6, version="1.4")
    head.scales = make_header(laspy, 0, "1.2", np.zeros(3)).scales
    for packed in (False, True):
        out = io.BytesIO()
        with laspy.open(out, "w", header=head, do_compress=packed, closefd=False) as writer:
            block = laspy.ScaleAwarePointRecord.zeros(30, header=head)
            block.x = block.y = block.z = np.linspace(1, 9, 30)
            writer.write_points(block)
        yield out.getvalue()


def e57(work: Path) -> Iterator[bytes]:
    path = work / "a.e57"
    file = pye57.E57(str(path), mode="w")
    for k in range(2):
        points = np.random.default_rng(k).normal(0, 5, (3, 20)).astype(np.float32)
        columns = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), points, strict=True))
        columns["cartesianInvalidState"] = np.zeros(20, np.int8)
        turn, place = np.array([1.0, 0, 0, 0]), np.array([1.0 * k, 0, 0])
        file.write_scan_raw(columns, rotation=turn, translation=place)
    file.close()
    yield path.read_bytes()


THREEDTK = ("scan000.3d", "scan000.pose", "scan001.3d.gz", "scan001.pose")


def threedtk(work: Path) -> Iterator[bytes]:  # noqa: ARG001
    text = "".join(f"{k}.5 {2 * k} 300\n" for k in range(20)).encode()
    pose = b"100 20 300\n0 90 0\n"
    yield join_parts([b"20 3\n" + text, pose, gzip.compress(b"# x y z\n" + text), pose])


def toml(work: Path) -> Iterator[bytes]:  # noqa: ARG001
    yield to_toml(Options()).encode()
    yield b"iterations = 3\n[em]\n[read]\nmax_range = 0x1F\nlaser_x = -1.5e3\ntopic = '''/scan'''\n"


def rows(work: Path) -> Iterator[bytes]:
    write_tum(work / "a.txt", START + np.arange(3, dtype=np.int64), np.tile(np.eye(4), (3, 1, 1)))
    yield (work / "a.txt").read_bytes()
    yield b"# t x y theta\n1.5 0 0 0.1\n2.5 1 2 0.2 # said\n"
    yield b"1.5 2.5 1 0 0 0 0 0.1\n2.5 3.5 1 0 0 0 0 0.1\n"
    writers.write(recording_2d(2), work / "a.log")
    yield (work / "a.log").read_bytes()


RESULT = (
    *("run.json", "beams/stamp_ns.npy", "beams/offset.npy", "beams/p_static.npy", "beams/hit.npy"),
    *("map.npz", "objects.json", "truth/static.npy", "truth/walls.npy", "truth/lasting.npy"),
    "truth/T_world_base.npy",
)


def result(work: Path) -> Iterator[bytes]:
    recording = recording_2d()
    place = work / "result"
    for inner in ("beams", "truth"):
        (place / inner).mkdir(parents=True)
    (place / "run.json").write_text(
        json.dumps({"input": {"path": "."}, "options": {"read": {"max_range": 8.0}}})
    )
    arrays = {
        "beams/stamp_ns": recording.stamp_ns,
        "beams/offset": recording.offset,
        "beams/p_static": np.full(recording.n_beams, 0.7, np.float32),
        "beams/hit": recording.hit,
        "truth/static": recording.hit,
        "truth/walls": np.ones((2, 4)),
        "truth/T_world_base": recording.T_odom_base,
    }
    for name, array in arrays.items():
        np.save(place / f"{name}.npy", array)
    grid = {
        "p_occupied": np.full((3, 4), 0.5, np.float32),
        "origin": np.zeros(3),
        "resolution": np.array(0.05),
    }
    write_npz(place / "map.npz", grid)
    yield read_files(place, RESULT)
