"""Seeds of fuzzing: bags of every kind, and messages."""

import io
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from corpus import START
from parts import join_parts
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "io" / "ros"))

from small_bags import DOUBLE, FLOAT, UINT32, Messages, cloud_message, write_bag


def _cloud(messages: Messages, stamp: int, big: bool = False) -> tuple[str, Any]:
    rng = np.random.default_rng(3)
    columns = [(name, kind, rng.normal(0, 5, 8)) for name, kind in (("x", FLOAT), ("y", FLOAT))]
    columns += [("z", DOUBLE, rng.normal(0, 5, 8)), ("t", UINT32, np.linspace(0, 9e7, 8))]
    return cloud_message(messages, stamp, columns, height=2, big=big)


def _image(messages: Messages, stamp: int) -> tuple[str, Any]:
    kind, data = "sensor_msgs/msg/Image", np.arange(2 * 3 * 3, dtype=np.uint8)
    return kind, messages.make(kind, messages.header(stamp, "cam"), 2, 3, "rgb8", 0, 9, data)


def _compressed_image(messages: Messages, stamp: int) -> tuple[str, Any]:
    kind, out = "sensor_msgs/msg/CompressedImage", io.BytesIO()
    Image.new("RGB", (4, 3), (9, 99, 200)).save(out, format="PNG")
    data = np.frombuffer(out.getvalue(), np.uint8)
    return kind, messages.make(kind, messages.header(stamp, "cam2"), "png", data)


def _camera_info(messages: Messages, stamp: int) -> tuple[str, Any]:
    names = "DKRP" if messages.encoding == "ros1" else "dkrp"
    values = [np.zeros(5), np.eye(3).ravel() * 4, np.eye(3).ravel(), np.zeros(12)]
    kind, matrices = "sensor_msgs/msg/CameraInfo", dict(zip(names, values, strict=True))
    return kind, messages.make(
        kind, messages.header(stamp, "cam"), 2, 3, distortion_model="plumb_bob", **matrices
    )


def _multi_echo(messages: Messages, stamp: int) -> tuple[str, Any]:
    kind, echoes = "sensor_msgs/msg/MultiEchoLaserScan", [np.float32(e) for e in ([1], [])]
    shape = {"angle_increment": 0.1, "time_increment": 0.001, "range_min": 0.1, "range_max": 9.0}
    ranges = [{"echoes": echo} for echo in echoes]
    return kind, messages.make(kind, messages.header(stamp, "laser2"), ranges=ranges, **shape)


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
        ("/other/image/compressed", START + 5, _compressed_image(messages, START + 5)),
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
    """Messages as parts: a line with type and topic, then the content."""
    messages = Messages(encoding)
    for content in (laser_messages(messages), cloud_messages(messages)):
        yield join_parts([_with_topic(messages, *message) for message in content])


def _with_topic(messages: Messages, topic: str, _: int, made: tuple[str, Any]) -> bytes:
    return f"{made[0]} {topic}\n".encode() + messages.raw(*made)
