"""PointCloud2 messages: collected by topic and frame, as a 3D recording."""

from array import array
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_types import Index
from stillmap.core.camera import Images
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.core.source import SensorNotes, Source
from stillmap.io.builder import RecordingBuilder, SkippedRecords
from stillmap.io.point_cloud.clouds import Cloud
from stillmap.io.point_cloud.table import convert_times, detect_clock, find_time_column
from stillmap.io.ros import tf
from stillmap.io.ros.messages import Message, SkippedByTopic, frame_name, stamp_ns
from stillmap.prepare.options import ReadOptions

NO_COORDINATES = "cloud without x, y and z"
WRONG_SIZE = "cloud whose size is not what it states"

_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_MAX_STEP = 1 << 16  # bytes of one point
_STILL = 1e-3  # m and entries of a rotation matrix: a sensor that moves less is fixed


class CloudLayout(NamedTuple):
    """The layout of the points in the data of a message.

    Attributes:
        dtype: of a point, with the fields that are read by name in lower case.
        time: name of the time field; None: there is none.
        shape: rows and columns of points.
        row_step: bytes from row to row.
    """

    dtype: np.dtype[Any]
    time: str | None
    shape: tuple[int, int]
    row_step: int

    @property
    def n_points(self) -> int:
        """Number of points of the message."""
        return self.shape[0] * self.shape[1]

    def view(self, data: NDArray[np.uint8]) -> NDArray[Any]:
        """The fields that are read, (rows, columns), as a view of the data of a message."""
        strides = self.row_step, self.dtype.itemsize
        return np.ndarray(self.shape, self.dtype, data, strides=strides)


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
    time = find_time_column(fields)
    order = ">" if message.is_bigendian else "<"
    columns: dict[str, tuple[str, int]] = {}
    for name in ("x", "y", "z", time):
        if name is not None and name in fields:
            kind, offset = _TYPES.get(int(fields[name].datatype)), int(fields[name].offset)
            if kind is not None and offset + int(kind[1]) <= step:
                columns[name] = f"{order}{kind}", offset
    if not columns.keys() >= set("xyz"):
        return NO_COORDINATES
    kinds, offsets = zip(*columns.values(), strict=True)
    dtype = np.dtype(
        {"names": list(columns), "formats": kinds, "offsets": offsets, "itemsize": step}
    )
    return CloudLayout(dtype, time if time in columns else None, (height, width), row)


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
    clock = None if layout.time is None else detect_clock(values[layout.time], None)
    if layout.time is None or clock is None:
        return Cloud(points)
    usable = np.asarray(np.isfinite(points).all(axis=1))
    stamp = stamp_ns(message.header)
    times = convert_times(values[layout.time], usable, clock, stamp)[1]
    return Cloud(points, times=times)


class CloudCollector:
    """Collects the scans of all sensors: one topic may carry several, by frame.

    Attributes:
        sensors: number of each sensor, by topic and frame.
        timed: sensors with beam times.
        number: (T,) number of the message of each scan on its topic, from 1.
        scans: stamps, sensors and points.
    """

    def __init__(self, scratch: Path | None, skipped: SkippedByTopic) -> None:
        self.skipped = skipped
        self.sensors: dict[tuple[str, str], int] = {}
        self.timed: set[int] = set()
        self.number = array("q")
        self.scans = RecordingBuilder(3, scratch, beam_times=True)

    def add(self, message: Message, raw: Any, number: int) -> str | None:
        """Add a message, by its number on the topic; returns the reason if it cannot be used."""
        cloud = parse_cloud(raw)
        if isinstance(cloud, str):
            return cloud
        stamp = stamp_ns(raw.header) or message.log_ns  # some drivers leave it unset
        name = message.channel.topic, frame_name(raw.header.frame_id)
        sensor = self.sensors.setdefault(name, len(self.sensors))
        if cloud.times is not None:
            self.timed.add(sensor)
        self.scans.add_scan(stamp, cloud.points, sensor=sensor, beam_time=cloud.times)
        self.number.append(number)
        return None

    def scans_in_time(self, sensor: int) -> Index:
        """The scans of a sensor in order of time; others are counted."""
        rows = np.flatnonzero(np.asarray(self.scans.sensor) == sensor)
        stamps, number = np.asarray(self.scans.stamp_ns)[rows], np.asarray(self.number)[rows]
        topic, _ = list(self.sensors)[sensor]
        return rows[self.skipped[topic].order_in_time(stamps, number)]


def read_clouds(
    clouds: CloudCollector,
    tree: tf.TransformTree,
    options: ReadOptions,
    find_images: Callable[[str], Images | None],
) -> Recording:
    """The 3D recording of all point clouds; `find_images` gives the images by the base frame.

    Raises:
        InputError: none can be used.
    """
    names = list(clouds.sensors)
    if not names:
        total = SkippedRecords().merge(*clouds.skipped.values())
        raise InputError(f"holds no usable cloud: {total.summary('message')}")
    stamps, sensor = np.asarray(clouds.scans.stamp_ns, np.int64), np.asarray(clouds.scans.sensor)
    counts = np.bincount(sensor).tolist()
    points = np.bincount(sensor, np.asarray(clouds.scans.length))
    # most points first: other clouds are derived from these
    order = sorted(range(len(names)), key=lambda k: (-points[k], names[k]))
    sensors = [tf.Sensor(*names[k], stamps[sensor == k]) for k in order]
    poses = tf.place_sensors(tree, sensors, options)
    chosen = [order[k] for k in poses.used]
    rows = [clouds.scans_in_time(k) for k in chosen]
    T, warnings = np.tile(np.eye(4), (len(names), 1, 1)), list(poses.warnings)
    for k, of_scans in zip(chosen, poses.T_base_sensor, strict=True):
        T[k] = of_scans[0]
        if np.abs(of_scans - of_scans[0]).max() > _STILL:
            text = "the sensor moves on the robot: its first pose is used"
            warnings.append(f"{names[k][0]}: {text}")
    odom, origin = tf.find_odometry(tree, poses.base, stamps, options, warnings)
    described = zip(names, counts, strict=True)
    recording = clouds.scans.build(
        T,
        selection=np.concatenate(rows),
        T_odom_base=odom,
        images=find_images(poses.base),
        record=np.asarray(clouds.number, np.int64),
        source=Source(
            sensors=[SensorNotes(name, frame, n) for (name, frame), n in described],
            base_frame=poses.base,
            base_frame_how=poses.how,
            odometry=origin,
            skipped=SkippedRecords().merge(*clouds.skipped.values()).by_reason(),
            duplicates=poses.omitted,
            warnings=warnings,
        ),
    )
    timed = clouds.timed.intersection(chosen)
    return recording if timed else replace(recording, beam_time=None)
