"""Makes small bags of every kind."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from stillmap.io.ros.message_fields import make_header
from stillmap.io.ros.messages import load_typestore
from stillmap.io.ros.writer import make_message

START, SECOND = 1_700_000_000_000_000_000, 10**9  # ns: of the first message, and between some
KINDS = ("bag", "db3", "mcap", "folder")
FLOAT, DOUBLE, UINT32, UINT16 = 7, 8, 6, 4
_KINDS = {FLOAT: "f4", DOUBLE: "f8", UINT32: "u4", UINT16: "u2"}


class Messages:
    """Makes messages of one generation of ROS."""

    def __init__(self, encoding: str) -> None:
        self.encoding = encoding
        self.store = load_typestore(encoding)

    def make(self, kind: str, *args: Any, **fields: Any) -> Any:
        """A message of its first fields and named ones; others are zero."""
        names = [name for name, _ in self.store.fielddefs[kind][1]]
        return make_message(self.store, kind, dict(zip(names, args, strict=False)) | fields)

    def header(self, stamp: int, frame: str) -> Any:
        return make_header(stamp, frame)

    def scan(
        self, stamp: int, ranges: Any, frame: str = "laser", **changes: Any
    ) -> tuple[str, Any]:
        ranges = np.asarray(ranges, np.float32)
        fields = {
            "angle_min": -0.5,
            "angle_max": 0.5,
            "angle_increment": 1.0 / max(len(ranges) - 1, 1),
            "range_min": 0.1,
            "range_max": 20.0,
        } | changes
        kind = "sensor_msgs/msg/LaserScan"
        return kind, self.make(kind, header=self.header(stamp, frame), ranges=ranges, **fields)

    def transform(
        self, stamp: int, parent: str, child: str, xyz: Any, q: Any = (0.0, 0.0, 0.0, 1.0)
    ) -> Any:
        place = _placed(xyz, q, "translation", "rotation")
        header = self.header(stamp, parent)
        return {"header": header, "child_frame_id": child, "transform": place}

    def tf(self, *transforms: Any) -> tuple[str, Any]:
        kind = "tf2_msgs/msg/TFMessage"
        return kind, self.make(kind, list(transforms))

    def odometry(
        self, stamp: int, xyz: Any, q: Any, frame: str = "odom", child: str = "base_link"
    ) -> tuple[str, Any]:
        kind, pose = "nav_msgs/msg/Odometry", {"pose": _placed(xyz, q, "position", "orientation")}
        return kind, self.make(kind, self.header(stamp, frame), child, pose)

    def raw(self, kind: str, message: Any) -> bytes:
        if self.encoding == "ros1":
            return bytes(self.store.serialize_ros1(message, kind))
        return bytes(self.store.serialize_cdr(message, kind))


def turned(theta: float, over: float = 0.0) -> tuple[float, float, float, float]:
    """Quaternion of a yaw after a roll."""
    c, s = np.cos(theta / 2), np.sin(theta / 2)
    a, b = np.cos(over / 2), np.sin(over / 2)
    return (c * b, s * b, s * a, c * a)


def _placed(xyz: Any, q: Any, *names: str) -> dict[str, Any]:
    at, turn = map(float, xyz), map(float, q)
    parts = dict(zip("xyz", at, strict=True)), dict(zip("xyzw", turn, strict=True))
    return dict(zip(names, parts, strict=True))


def write_bag(
    folder: Path,
    kind: str,
    messages: Messages,
    content: list[tuple[str, int, tuple[str, Any]]],
    name: str = "tiny",
    **packing: Any,
) -> Path:
    path = folder / (f"{name}.bag" if kind == "bag" else name)
    if kind == "bag":
        writer: Any = Writer1(path)
    else:
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer = Writer2(path, version=9, storage_plugin=plugin)
    if packing:
        writer.set_compression(**packing)
    with writer:
        connections: dict[str, Any] = {}
        for topic, log_ns, (message_type, message) in content:
            if topic not in connections:
                connections[topic] = writer.add_connection(
                    topic, message_type, typestore=messages.store
                )
            raw = message if isinstance(message, bytes) else messages.raw(message_type, message)
            writer.write(connections[topic], log_ns, raw)
    if kind in ("db3", "mcap"):
        single = folder / f"{name}.{kind}"
        shutil.move(path / single.name, single)
        return single
    return path


def cloud_message(
    messages: Messages,
    stamp: int,
    columns: list[tuple[str, int, Any]],
    *,
    frame: str = "lidar",
    height: int = 1,
    step: int | None = None,
    padding: int = 0,
    big: bool = False,
    **changes: Any,
) -> tuple[str, Any]:
    """A cloud of named columns (name, type, values), in this order; rows may be padded."""
    n = len(columns[0][2])
    offsets, at = [], 0
    for _, kind, _ in columns:
        offsets.append(at)
        at += np.dtype(_KINDS[kind]).itemsize
    step = step or at
    order = ">" if big else "<"
    names = [name for name, _, _ in columns]
    formats = [order + _KINDS[kind] for _, kind, _ in columns]
    dtype = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})
    values = np.zeros(n, dtype)
    for name, _, column in columns:
        values[name] = column
    width = n // height
    rows = values.view(np.uint8).reshape(height, width * step)
    data = np.concatenate([rows, np.full((height, padding), 0xAB, np.uint8)], axis=1)
    fields = [
        {"name": name, "offset": o, "datatype": kind, "count": 1}
        for (name, kind, _), o in zip(columns, offsets, strict=True)
    ]
    row_step = width * step + padding
    kind = "sensor_msgs/msg/PointCloud2"
    layout = height, width, fields, big, step, row_step, data.ravel(), True
    return kind, messages.make(kind, messages.header(stamp, frame), *layout, **changes)
