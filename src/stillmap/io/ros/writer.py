"""Writes ROS bags of any kind, message by message, and the messages of recordings and results."""

import shutil
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rosbags import interfaces, rosbag1, rosbag2
from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore

from stillmap.core import files
from stillmap.core.array_types import Float
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.io.ros import messages
from stillmap.io.ros.message_fields import (
    BASE,
    ODOM,
    Fields,
    LaserScanEncoder,
    make_cloud,
    make_odometry,
    make_transforms,
)

Send = Callable[[int, Fields], None]  # stamp in ns, message
SendRaw = Callable[[int, bytes], None]

PATH = "nav_msgs/msg/Path"
GRID = "nav_msgs/msg/OccupancyGrid"
MARKERS = "visualization_msgs/msg/MarkerArray"

# the oldest version that stores message definitions: ROS 2 before Jazzy reads no newer one
_VERSION: Literal[8] = 8
_MAX_SECONDS = {"bag": 1 << 32, "ros2": 1 << 31, "db3": 1 << 31, "mcap": 1 << 31}  # of stamps
_FOREVER = interfaces.QosTime(9223372036, 854775807)
_TRANSIENT_LOCAL = interfaces.Qos(
    interfaces.QosHistory.KEEP_LAST,
    1,
    interfaces.QosReliability.RELIABLE,
    interfaces.QosDurability.TRANSIENT_LOCAL,
    _FOREVER,
    _FOREVER,
    interfaces.QosLiveliness.AUTOMATIC,
    _FOREVER,
    False,
)


class BagWriter:
    """An open bag of a kind, written through an open writer of rosbags."""

    def __init__(self, kind: messages.BagKind, writer: rosbag1.Writer | rosbag2.Writer) -> None:
        self.is_ros1 = kind == "bag"
        self._writer = writer
        self._store = store = messages.load_typestore("ros1" if self.is_ros1 else "cdr")
        self._serialize = store.serialize_ros1 if self.is_ros1 else store.serialize_cdr

    def add_topic(self, name: str, type: str, *, latched: bool = False) -> Send:
        """Add a topic; returns a function that writes a message at a stamp in nanoseconds.

        Late subscribers still get the last message of a `latched` one.
        """
        connection = self._add_connection(name, type, latched, typestore=self._store)

        def send(stamp_ns: int, fields: Fields) -> None:
            raw = self.serialize(make_message(self._store, type, fields), type)
            self._writer.write(connection, stamp_ns, raw)

        return send

    def copy_topic(self, channel: messages.Channel) -> SendRaw | None:
        """Add a topic like one of another bag; returns a function that writes raw messages.

        None where the definition of its type is not known.
        """
        options: dict[str, Any] = {"typestore": self._store}
        digest = channel.digest or messages.hash_definition(channel)
        if channel.definition and digest:
            hash_name = "md5sum" if self.is_ros1 else "rihs01"
            options = {"msgdef": channel.definition, hash_name: digest}
        elif channel.type not in self._store.fielddefs:
            return None
        if self.is_ros1:
            options |= {"callerid": channel.publisher} if channel.publisher else {}
        elif channel.qos:
            options["offered_qos_profiles"] = list(channel.qos)
        writer = self._writer
        connection = self._add_connection(channel.topic, channel.type, channel.latched, **options)
        return lambda stamp, raw: writer.write(connection, stamp, raw)

    def serialize(self, message: Any, type: str) -> bytes:
        """The bytes of a message in this kind of bag."""
        return bytes(self._serialize(message, type))

    def _add_connection(self, topic: str, type: str, latched: bool, **options: Any) -> Any:
        if self.is_ros1:
            options = {"callerid": "/stillmap", "latching": int(latched), **options}
        else:
            options = {"offered_qos_profiles": [_TRANSIENT_LOCAL] if latched else [], **options}
        return self._writer.add_connection(topic, type, **options)


def make_message(store: Typestore, type: str, fields: Fields) -> Any:
    """A message of a type; its parts are given by their fields, or as messages."""
    definition = store.fielddefs[type][1]
    values = {name: _make_field(store, kind, fields.get(name)) for name, kind in definition}
    return store.types[type](**values)


def _make_field(store: Typestore, kind: Any, given: Any) -> Any:
    node, form = kind
    if node == Nodetype.NAME:
        return make_message(store, form, given or {}) if isinstance(given, dict | None) else given
    if node == Nodetype.BASE:
        return given if given is not None else "" if form[0] == "string" else 0
    (item, name), count = form
    if item == Nodetype.NAME:
        return [_make_field(store, (item, name), part) for part in given or ()]
    return np.zeros(count, name[0]) if given is None else given


@contextmanager
def new_bag(
    path: Path, kind: messages.BagKind, *, overwrite: bool = False, mcap: bool = False
) -> Iterator[BagWriter]:
    """Write a bag, which lies at `path` once the block ends without an exception.

    Args:
        path: a file, or the folder of kind "ros2".
        kind: ROS 1 `bag`; `ros2`, a folder with `metadata.yaml`; its file alone: `db3` or `mcap`.
        overwrite: replace an existing folder; a file is replaced in any case.
        mcap: store messages of kind "ros2" as MCAP.

    Raises:
        InputError: it cannot be written.
    """
    with ExitStack() as stack:
        if kind == "ros2":
            work = stack.enter_context(files.atomic_folder(path, "metadata.yaml", overwrite))
            name = files.shorten(files.resolve_output(path).name)
        else:
            work, name = stack.enter_context(files.atomic_file(path)), "bag"
        # rosbags refuses existing files; for ROS 2 it makes a folder, and names its files after it
        made = stack.enter_context(files.temporary_folder(path)) / name
        try:
            with _open_writer(made, kind, mcap or kind == "mcap") as writer:
                yield BagWriter(kind, writer)
        except sqlite3.Error as error:  # a full disk
            raise InputError(f"cannot be written: {error}", where=str(path)) from error
        if kind == "ros2":
            for file in made.iterdir():
                shutil.move(file, work / file.name)
        else:
            shutil.move(made if kind == "bag" else made / f"{name}.{kind}", work)


def _open_writer(path: Path, kind: messages.BagKind, mcap: bool) -> rosbag1.Writer | rosbag2.Writer:
    if kind == "bag":
        return rosbag1.Writer(path)
    plugin = rosbag2.StoragePlugin.MCAP if mcap else rosbag2.StoragePlugin.SQLITE3
    writer = rosbag2.Writer(path, version=_VERSION, storage_plugin=plugin)
    if mcap:
        writer.set_compression(rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD)
    return writer


def require_stamps(first_ns: int, last_ns: int, kind: messages.BagKind) -> None:
    """Refuse stamps that such a bag cannot hold.

    Raises:
        InputError: they are negative or too late.
    """
    if first_ns < 0 or last_ns >= _MAX_SECONDS[kind] * 10**9:
        span = f"stamps from {first_ns / 1e9:.0f} to {last_ns / 1e9:.0f} s"
        hint = f"0 to {_MAX_SECONDS[kind]} s"
        raise InputError(f"{span} do not fit into a ROS bag", hint=hint)


def write_recording(
    kind: messages.BagKind, recording: Recording, path: Path, overwrite: bool = False
) -> list[str]:
    """Write a recording as a ROS bag: scans, odometry, and the sensors' extrinsics.

    2D scans become LaserScan on `/scan`, `/scan2`, ..., with +inf for no return (REP 117), 3D
    scans PointCloud2 on `/points`, ...; odometry becomes Odometry on `/odom` and transforms from
    odom to base_link at every scan. All stamps are the recording's.

    Returns:
        What could not be written, a sentence each.

    Raises:
        InputError: the bag cannot be written or cannot hold such a recording.
    """
    stamps, n_free = recording.stamp_ns, 0
    if recording.n_scans:
        require_stamps(int(stamps[0]), int(stamps[-1]), kind)
    lasers = LaserScanEncoder(recording) if recording.dimension == 2 else None
    with new_bag(path, kind, overwrite=overwrite) as bag:
        frames = write_sensor_frames(bag, recording)
        topic, type = "points", messages.POINT_CLOUD
        if lasers is not None:
            topic, type = "scan", messages.LASER_SCAN
        sends = [bag.add_topic(f"/{name}", type) for name in number_names(topic, len(frames))]
        send_odometry = _odometry_sender(bag, recording)
        for t in recording.iter_scans(range(recording.n_scans)):
            send_odometry(t)
            sensor, beams = int(recording.sensor[t]), recording.beams_of(t)
            if lasers is None:
                message = make_cloud(recording, t, frames[sensor])
                free = recording.points[beams][~recording.hit[beams]]
                n_free += int(np.count_nonzero(~np.isnan(free).any(axis=1)))
            else:
                message = lasers.make_message(t, frames[sensor], lasers.ranges(t))
            sends[sensor](int(stamps[t]), message)
    lost = [f"{n_free} beams at maximum range are left out: they have no points"] * bool(n_free)
    return lost if lasers is None else lasers.describe_losses()


def write_sensor_frames(
    bag: BagWriter, recording: Recording, more: Sequence[tuple[str, str, Float]] = ()
) -> list[str]:
    """Write the sensors' extrinsics to /tf_static, and more transforms; returns their S frames."""
    name = "laser" if recording.dimension == 2 else "lidar"
    frames = number_names(name, len(recording.T_base_sensor))
    send = bag.add_topic("/tf_static", messages.TF, latched=True)
    if recording.n_scans:
        first = int(recording.stamp_ns[0])
        poses = [(BASE, f, T) for f, T in zip(frames, recording.T_base_sensor, strict=True)]
        send(first, make_transforms(first, [*poses, *more]))
    return frames


def number_names(name: str, count: int) -> list[str]:
    """`name`, `name2`, `name3`, ..."""
    return [name, *(f"{name}{k}" for k in range(2, count + 1))][:count]


def _odometry_sender(bag: BagWriter, recording: Recording) -> Callable[[int], None]:
    """A function that writes the odometry of a scan."""
    T_odom_base = recording.T_odom_base
    if T_odom_base is None:
        return lambda t: None  # noqa: ARG005
    send_tf = bag.add_topic("/tf", messages.TF)
    send_odometry = bag.add_topic("/odom", messages.ODOMETRY)

    def send(t: int) -> None:
        stamp, T = int(recording.stamp_ns[t]), T_odom_base[t]
        if t and stamp == recording.stamp_ns[t - 1] and np.array_equal(T, T_odom_base[t - 1]):
            return  # two sensors at the same time
        send_tf(stamp, make_transforms(stamp, [(ODOM, BASE, T)]))
        send_odometry(stamp, make_odometry(stamp, T))

    return send
