"""Collects PointCloud2 messages by topic and frame."""

from array import array
from collections import Counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.io.builder import ReadContext, RecordingBuilder, SkippedRecords
from stillmap.io.point_cloud import time_field
from stillmap.io.point_cloud.binary_table import record_dtype
from stillmap.io.point_cloud.scans import Cloud
from stillmap.io.ros.bag_types import Message
from stillmap.io.ros.laser_scan import UNREADABLE
from stillmap.io.ros.messages import decode, frame_name, stamp_ns

NO_COORDINATES = "cloud without x, y and z"
WRONG_SIZE = "cloud whose size is not what it states"

_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_MAX_STEP = 1 << 16  # bytes of one point


class CloudLayout(NamedTuple):
    """The layout of the points in the data of a message.

    Attributes:
        columns: type and byte offset of the fields that are read, by name in lower case.
        time: name of the time field; None: there is none.
        shape: rows and columns of points.
        strides: bytes from row to row, and from point to point.
    """

    columns: dict[str, tuple[str, int]]
    time: str | None
    shape: tuple[int, int]
    strides: tuple[int, int]

    @property
    def n_points(self) -> int:
        """Number of points of the message."""
        return self.shape[0] * self.shape[1]

    def view(self, data: NDArray[np.uint8]) -> NDArray[Any]:
        """The fields that are read, (rows, columns), as a view of the data of a message."""
        dtype = record_dtype(self.columns, self.strides[1])
        return np.ndarray(self.shape, dtype, data, strides=self.strides)


def find_layout(message: Any) -> CloudLayout | str:
    """The layout of a PointCloud2 message with fields in any order, or why it cannot be used."""
    fields = {str(f.name).lower(): f for f in message.fields}
    step, width, height = int(message.point_step), int(message.width), int(message.height)
    row = int(message.row_step) or width * step
    if not 0 < step <= _MAX_STEP or row < width * step:
        return WRONG_SIZE
    end = (height - 1) * row + width * step if width and height else 0
    if end > len(message.data):
        return WRONG_SIZE
    time = time_field.find_time_column(fields)
    kept = [name for name in ("x", "y", "z", time) if name in fields]
    order = ">" if message.is_bigendian else "<"
    known = {name: at for name in kept if (at := _column(fields[name], order, step)) is not None}
    if not known.keys() >= set("xyz"):
        return NO_COORDINATES
    return CloudLayout(known, time if time in known else None, (height, width), (row, step))


def parse_cloud(message: Any) -> Cloud | str:
    """The cloud of a PointCloud2 message, or why it cannot be used.

    Its times are in seconds after the stamp; points are not finite for no return.
    """
    layout = find_layout(message)
    if isinstance(layout, str):
        return layout
    if layout.n_points == 0:
        return Cloud(np.empty((0, 3), np.float32))
    values = layout.view(message.data).reshape(-1)
    points = np.stack([values[name].astype(np.float32) for name in "xyz"], axis=1)
    time = layout.time
    times = None if time is None else _times(values[time], points, stamp_ns(message.header))
    return Cloud(points, times=times)


def _times(
    values: NDArray[Any], points: NDArray[np.float32], stamp: int
) -> NDArray[np.float64] | None:
    clock = time_field.detect_clock(values, None)
    if clock is None:
        return None
    usable = np.asarray(np.isfinite(points).all(axis=1))
    return time_field.convert_times(values, usable, clock, stamp)[1]


def _column(field: Any, order: str, step: int) -> tuple[str, int] | None:
    kind = _TYPES.get(int(field.datatype))
    if kind is None or int(field.offset) + int(kind[1]) > step:
        return None
    return f"{order}{kind}", int(field.offset)


class CloudCollector:
    """Collects the scans of all sensors: one topic may carry several, by frame.

    Attributes:
        sensors: number of each sensor, by topic and frame.
        timed: sensors with beam times.
        number: (T,) number of the message of each scan on its topic, from 1.
        scans: stamps, sensors and points.
        skipped: messages that were skipped, by topic.
    """

    def __init__(self, context: ReadContext) -> None:
        self._count: Counter[str] = Counter()  # messages by topic
        self.skipped: dict[str, SkippedRecords] = {}
        self.sensors: dict[tuple[str, str], int] = {}
        self.timed: set[int] = set()
        self.number = array("q")
        self.scans = RecordingBuilder(3, context, beam_times=True)

    def add_message(self, message: Message, *, skip: bool = False) -> None:
        """Add a message, or `skip` it undecoded; one that cannot be used is counted."""
        topic = message.channel.topic
        self._count[topic] += 1
        if skip:
            return
        frame, stamp = "", 0
        cloud: Cloud | str
        try:
            raw = decode(message)
            frame, stamp = frame_name(raw.header.frame_id), stamp_ns(raw.header)
            cloud = parse_cloud(raw)
        except Exception:  # any error of rosbags about damaged bytes
            cloud = UNREADABLE
        if isinstance(cloud, str):
            self.skipped.setdefault(topic, SkippedRecords()).add(cloud, self._count[topic])
            return
        stamp = stamp or message.log_ns  # some drivers leave it unset
        sensor = self.sensors.setdefault((topic, frame), len(self.sensors))
        if cloud.times is not None:
            self.timed.add(sensor)
        self.scans.add_scan(stamp, cloud.points, sensor=sensor, beam_time=cloud.times)
        self.number.append(self._count[topic])
