"""What fuzzing begins with: small sound recordings of every format, made here and now."""

import gzip
import io
import json
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import lzf
import numpy as np
import pye57
from parts import joined
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "formats" / "ros"))

from small_bags import Messages, write_bag

from stillmap import se2
from stillmap.options import to_toml
from stillmap.output.map_npz import write_npz
from stillmap.pipeline import Options
from stillmap.recording import Recording, folder, writers
from stillmap.recording.clouds.las import _header
from stillmap.recording.images import Camera, Images
from stillmap.recording.tum import write_tum

START = 1_700_000_000_000_000_000
FLOAT, DOUBLE, U32 = 7, 8, 6


def planar(scans: int = 6, beams: int = 9) -> Recording:
    """A robot that drives past a wall."""
    rng = np.random.default_rng(1)
    angle = np.linspace(-1.2, 1.2, beams)
    length = rng.uniform(1.0, 8.0, (scans, beams, 1))
    points = length * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    t = np.arange(scans)
    return Recording(
        stamp_ns=START + 10**8 * t.astype(np.int64),
        offset=np.arange(scans + 1, dtype=np.int64) * beams,
        points=points.reshape(-1, 2).astype(np.float32),
        hit=rng.random(scans * beams) < 0.9,
        T_base_sensor=se2.matrix(0.1, 0.0, 0.0)[None],
        sensor=np.zeros(scans, np.int32),
        T_odom_base=se2.matrix(0.1 * t, 0.01 * t, 0.02 * t),
    )


def space(scans: int = 3, beams: int = 12) -> Recording:
    """The same in space, with poses, times of beams and pictures."""
    rng = np.random.default_rng(2)
    T = np.tile(np.eye(4), (scans, 1, 1))
    T[:, 0, 3] = 6.0 + np.arange(scans)
    pictures = [np.full((4, 6, 3), 50 * k, np.uint8) for k in range(2)]
    camera = Camera("cam", 6, 4, np.diag([4.0, 4.0, 1.0]), "plumb_bob", np.zeros(5), np.eye(4))
    images = Images(
        START + np.arange(2, dtype=np.int64), np.zeros(2, np.int32), (camera,), pictures.__getitem__
    )
    return Recording(
        stamp_ns=START + 10**8 * np.arange(scans, dtype=np.int64),
        offset=np.arange(scans + 1, dtype=np.int64) * beams,
        points=rng.normal(0, 5, (scans * beams, 3)).astype(np.float32),
        hit=np.ones(scans * beams, bool),
        T_base_sensor=np.eye(4)[None],
        sensor=np.zeros(scans, np.int32),
        T_odom_base=T,
        T_recorded_base=T,
        beam_time=np.tile(np.linspace(0, 0.09, beams, dtype=np.float32), scans),
        images=images,
    )


def parts_of(place: Path, names: tuple[str, ...]) -> bytes:
    """The files of a folder in the order of their names here; none where one is not there."""
    files = [place / name for name in names]
    return joined([file.read_bytes() if file.is_file() else b"" for file in files])


def carmen(work: Path) -> Iterator[bytes]:
    writers.write(planar(), work / "a.log")
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


OURS = (
    *("recording.json", "stamp_ns.npy", "offset.npy", "points.npy", "hit.npy"),
    *("T_base_sensor.npy", "sensor.npy", "T_odom_base.npy", "beam_time.npy", "T_recorded_base.npy"),
    *("image_stamp_ns.npy", "image_camera.npy", "images/000000.png", "images/000001.npy"),
)


def ours(work: Path) -> Iterator[bytes]:
    for name, recording in (("flat", planar()), ("space", space())):
        folder.write(recording, work / name)
        yield parts_of(work / name, OURS)


def _cloud(messages: Messages, stamp: int, big: bool = False) -> tuple[str, Any]:
    rng, order = np.random.default_rng(3), ">" if big else "<"
    layout = [("x", FLOAT, "f4"), ("y", FLOAT, "f4"), ("z", DOUBLE, "f8"), ("t", U32, "u4")]
    dtype = np.dtype([(name, order + kind) for name, _, kind in layout])
    rows = np.zeros(8, dtype)
    for name in "xyz":
        rows[name] = rng.normal(0, 5, 8)
    rows["t"] = np.linspace(0, 9e7, 8)
    fields = [
        messages.make("sensor_msgs/msg/PointField", name, dtype.fields[name][1], kind, 1)
        for name, kind, _ in layout
    ]
    kind = "sensor_msgs/msg/PointCloud2"
    return kind, messages.make(
        kind,
        messages.header(stamp, "lidar"),
        height=2,
        width=4,
        fields=fields,
        is_bigendian=big,
        point_step=dtype.itemsize,
        row_step=4 * dtype.itemsize,
        data=rows.view(np.uint8).ravel(),
        is_dense=True,
    )


def _image(messages: Messages, stamp: int) -> tuple[str, Any]:
    kind, data = "sensor_msgs/msg/Image", np.arange(2 * 3 * 3, dtype=np.uint8)
    return kind, messages.make(kind, messages.header(stamp, "cam"), 2, 3, "rgb8", 0, 9, data)


def _packed_image(messages: Messages, stamp: int) -> tuple[str, Any]:
    kind, out = "sensor_msgs/msg/CompressedImage", io.BytesIO()
    Image.new("RGB", (4, 3), (9, 99, 200)).save(out, format="PNG")
    data = np.frombuffer(out.getvalue(), np.uint8)
    return kind, messages.make(kind, messages.header(stamp, "cam2"), "png", data)


def _camera_info(messages: Messages, stamp: int) -> tuple[str, Any]:
    names = "DKRP" if messages.encoding == "ros1" else "dkrp"
    values = [np.zeros(5), np.eye(3).ravel() * 4, np.eye(3).ravel(), np.zeros(12)]
    region = messages.make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
    kind = "sensor_msgs/msg/CameraInfo"
    return kind, messages.make(
        kind,
        header=messages.header(stamp, "cam"),
        height=2,
        width=3,
        distortion_model="plumb_bob",
        binning_x=0,
        binning_y=0,
        roi=region,
        **dict(zip(names, values, strict=True)),
    )


def _multi_echo(messages: Messages, stamp: int) -> tuple[str, Any]:
    echo = [messages.make("sensor_msgs/msg/LaserEcho", np.array(e, np.float32)) for e in ([1], [])]
    kind = "sensor_msgs/msg/MultiEchoLaserScan"
    numbers = dict.fromkeys(("angle_max", "scan_time"), 0.0)
    return kind, messages.make(
        kind,
        header=messages.header(stamp, "laser2"),
        angle_min=0.0,
        angle_increment=0.1,
        time_increment=0.001,
        range_min=0.1,
        range_max=9.0,
        ranges=echo,
        intensities=[],
        **numbers,
    )


def laser_messages(messages: Messages) -> list[tuple[str, int, tuple[str, Any]]]:
    fixed = messages.transform(START, "base_link", "laser", (0.1, 0, 0))
    out = [("/tf_static", START, messages.tf(fixed))]
    for k in range(4):
        stamp = START + k * 10**8
        moving = messages.transform(stamp, "odom", "base_link", (0.1 * k, 0, 0))
        out += [
            ("/tf", stamp, messages.tf(moving)),
            ("/odom", stamp, messages.odometry(stamp, (0.1 * k, 0, 0), (0, 0, 0, 1))),
            ("/scan", stamp, messages.scan(stamp, [1.0, 2.0 + k, np.inf], time_increment=0.01)),
        ]
    return [*out, ("/echoes", START, _multi_echo(messages, START))]


def cloud_messages(messages: Messages) -> list[tuple[str, int, tuple[str, Any]]]:
    fixed = messages.transform(START, "base_link", "lidar", (0.1, 0, 0.5))
    out = [("/tf_static", START, messages.tf(fixed))]
    for k in range(3):
        stamp = START + k * 10**8
        moving = messages.transform(stamp, "odom", "base_link", (0.1 * k, 0, 0))
        out += [
            ("/tf", stamp, messages.tf(moving)),
            ("/points", stamp, _cloud(messages, stamp, big=k == 2)),
        ]
    return [
        *out,
        ("/cam/image_raw", START, _image(messages, START)),
        ("/cam/camera_info", START, _camera_info(messages, START)),
        ("/other/image/compressed", START + 5, _packed_image(messages, START + 5)),
    ]


def _bags(work: Path, kind: str, packings: list[dict[str, Any]]) -> Iterator[bytes]:
    messages = Messages("ros1" if kind == "bag" else "cdr")
    for number, packing in enumerate(packings):
        content = (cloud_messages if number == 1 else laser_messages)(messages)
        path = write_bag(work, kind, messages, content, f"b{number}", **packing)
        yield path.read_bytes()
        path.unlink()
        shutil.rmtree(work / f"b{number}", ignore_errors=True)


def bag1(work: Path) -> Iterator[bytes]:
    from rosbags.rosbag1 import Writer

    kinds = Writer.CompressionFormat
    packings = [{}, {}, {"fmt": kinds.BZ2}, {"fmt": kinds.LZ4}]
    yield from _bags(work, "bag", packings)


def mcap(work: Path) -> Iterator[bytes]:
    from rosbags.rosbag2 import CompressionFormat, CompressionMode

    packed = {"mode": CompressionMode.STORAGE, "fmt": CompressionFormat.ZSTD}
    yield from _bags(work, "mcap", [{}, {}, packed])


def db3(work: Path) -> Iterator[bytes]:
    from rosbags.rosbag2 import CompressionFormat, CompressionMode

    packed = {"mode": CompressionMode.MESSAGE, "fmt": CompressionFormat.ZSTD}
    yield from _bags(work, "db3", [{}, {}, packed])


def messages_of(encoding: str) -> Iterator[bytes]:
    """Messages as parts: their type and topic in a line, then their bytes."""
    messages = Messages(encoding)
    for content in (laser_messages(messages), cloud_messages(messages)):
        yield joined(
            [
                f"{kind} {topic}\n".encode() + messages.raw(kind, message)
                for topic, _, (kind, message) in content
            ]
        )


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
    writers.write(space(), work / "k", name="kitti")
    (work / "k" / "image_2").mkdir()
    for k in range(3):
        Image.new("L", (4, 3), 60 * k).save(work / "k" / "image_2" / f"{k:06d}.png")
    row = "1 0 0 0 0 1 0 0 0 0 1 0"
    (work / "k" / "calib.txt").write_text(f"P0: {row}\nP2: {row}\nTr: {row}\n")
    yield parts_of(work / "k", KITTI)


def drive(work: Path) -> Iterator[bytes]:  # noqa: ARG001
    R, P = "R: 1 0 0 0 1 0 0 0 1", "P_rect_02: 1 0 0 0 0 1 0 0 0 0 1 0"
    times = "2011-09-26 13:02:25.594360375\n2011-09-26 13:02:25.697360375\n"
    placed = f"{R}\nT: 0 0 0.1\n".encode()
    cameras = f"R_rect_00: {R[3:]}\n{P}\n".encode()
    where = b"49.0 8.4 112.8 0.02 0.00001 -1.2 0 0 0\n"
    sweep = np.random.default_rng(4).normal(0, 5, (6, 4)).astype("<f4").tobytes()
    out = io.BytesIO()
    Image.new("L", (4, 3)).save(out, format="PNG")
    yield joined(
        [
            *(times.encode(), placed, cameras, placed, where, where, times.encode()[:30]),
            *(sweep, sweep, out.getvalue()),
        ]
    )


def pcd(work: Path) -> Iterator[bytes]:
    writers.write(space(), work / "p", name="pcd")
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
    writers.write(space(), work / "a.ply")
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
        writers.write(space(), work / name)
        yield (work / name).read_bytes()
    import laspy

    # a later version, with another format of points
    head = laspy.LasHeader(point_format=6, version="1.4")
    head.scales = _header(laspy, np.eye(4)[None]).scales
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


UOS = ("scan000.3d", "scan000.pose", "scan001.3d.gz", "scan001.pose")


def uos(work: Path) -> Iterator[bytes]:  # noqa: ARG001
    text = "".join(f"{k}.5 {2 * k} 300\n" for k in range(20)).encode()
    pose = b"100 20 300\n0 90 0\n"
    yield joined([b"20 3\n" + text, pose, gzip.compress(b"# x y z\n" + text), pose])


SCENES = (
    *("frame-000000.depth.png", "frame-000000.color.png", "frame-000000.pose.txt"),
    *("frame-000001.depth.png", "frame-000001.color.png", "frame-000001.pose.txt"),
    "camera-intrinsics.txt",
)
TUM = (
    *("depth.txt", "rgb.txt", "groundtruth.txt"),
    *("depth/0.png", "depth/1.png", "rgb/0.png", "camera.txt"),
)


def _pictures() -> tuple[list[bytes], list[bytes]]:
    """Two pictures of depth, two of colours, as small as they are of use."""
    rng = np.random.default_rng(5)
    out: tuple[list[bytes], list[bytes]] = ([], [])
    for values in (rng.integers(900, 1100, (12, 16)), rng.integers(0, 255, (12, 16, 3))):
        for k in range(2):
            stream = io.BytesIO()
            kind = np.uint16 if values.ndim == 2 else np.uint8
            Image.fromarray((values + k).astype(kind)).save(stream, format="PNG")
            out[values.ndim - 2].append(stream.getvalue())
    return out


def scenes(work: Path) -> Iterator[bytes]:  # noqa: ARG001
    depth, colour = _pictures()
    pose = b"0 0 1 0\n-1 0 0 0\n0 -1 0 0.5\n0 0 0 1\n"
    each = [part for k in range(2) for part in (depth[k], colour[k], pose)]
    yield joined([*each, b"20 0 7.5\n0 20 5.5\n0 0 1\n"])


def tum(work: Path) -> Iterator[bytes]:  # noqa: ARG001
    depth, colour = _pictures()
    lists = (b"# a\n1.5 depth/0.png\n1.6 depth/1.png\n", b"1.5 rgb/0.png\n")
    poses = b"# t\n1.45 0 0 1 0 0 0 1\n1.65 0.1 0 1 0 0 0 1\n"
    yield joined([*lists, poses, *depth, colour[0], b"20 0 7.5\n0 20 5.5\n0 0 1\n"])


def cameras(work: Path) -> Iterator[bytes]:  # noqa: ARG001
    yield (
        b'[color]\nK = [[20, 0, 7.5], [0, 20, 5.5], [0, 0, 1]]\nmodel = "plumb_bob"\n'
        b"distortion = [-0.1, 0.01, 0, 0, 0]\ntranslation = [0, 0.1, 0]\nrpy = [0, 0, 1.5]\n"
        b"time_offset = -0.5\n"
    )
    yield (
        b"[color]\nfx = 20\nfy = 20\ncx = 7.5\ncy = 5.5\nwidth = 16\nheight = 12\n"
        b"translation = [0, 0, 0]\nquaternion = [-0.5, 0.5, -0.5, 0.5]\n"
        b'[more]\nfolder = "more"\ntimes = "times.txt"\nmodel = "equidistant"\n'
        b"distortion = [0.1, 0, 0, 0]\n"
        b"T_base_camera = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n"
    )


def toml(work: Path) -> Iterator[bytes]:  # noqa: ARG001
    yield to_toml(Options()).encode()
    yield b"iterations = 3\n[em]\n[read]\nmax_range = 0x1F\nlaser_x = -1.5e3\ntopic = '''/scan'''\n"


def rows(work: Path) -> Iterator[bytes]:
    write_tum(work / "a.txt", START + np.arange(3, dtype=np.int64), np.tile(np.eye(4), (3, 1, 1)))
    yield (work / "a.txt").read_bytes()
    yield b"# t x y theta\n1.5 0 0 0.1\n2.5 1 2 0.2 # said\n"
    yield b"1.5 2.5 1 0 0 0 0 0.1\n2.5 3.5 1 0 0 0 0 0.1\n"
    writers.write(planar(2, 3), work / "a.log")
    yield (work / "a.log").read_bytes()


RESULT = (
    *("run.json", "beams/stamp_ns.npy", "beams/offset.npy", "beams/p_static.npy", "beams/hit.npy"),
    *("map.npz", "objects.json", "truth/static.npy", "truth/walls.npy", "truth/lasting.npy"),
    "truth/T_world_base.npy",
)


def result(work: Path) -> Iterator[bytes]:
    recording = planar()
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
    yield parts_of(place, RESULT)
