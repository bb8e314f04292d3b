"""Writes a new ROS bag of any kind, message by message."""

import os
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Literal

from rosbags import rosbag1, rosbag2
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from stillmap.core.errors import InputError
from stillmap.core.files import (
    atomic_file,
    atomic_folder,
    resolve_output,
    shorten,
    temporary_folder,
)
from stillmap.io.ros.bag_types import BagKind, Channel
from stillmap.io.ros.messages import load_typestore

Send = Callable[[int, Any], None]  # stamp in ns, message
SendRaw = Callable[[int, bytes], None]

# the oldest version that stores message definitions: ROS 2 before Jazzy reads no newer one
_VERSION: Literal[8] = 8
_MAX_SECONDS = {"bag": 1 << 32, "ros2": 1 << 31, "db3": 1 << 31, "mcap": 1 << 31}  # of stamps
_FOREVER = QosTime(9223372036, 854775807)
_TRANSIENT_LOCAL = Qos(
    QosHistory.KEEP_LAST,
    1,
    QosReliability.RELIABLE,
    QosDurability.TRANSIENT_LOCAL,
    _FOREVER,
    _FOREVER,
    QosLiveliness.AUTOMATIC,
    _FOREVER,
    False,
)


class BagWriter:
    """An open bag of a kind, written through an open writer of rosbags."""

    def __init__(self, kind: BagKind, writer: rosbag1.Writer | rosbag2.Writer) -> None:
        self.is_ros1 = kind == "bag"
        self._writer = writer
        self._store = store = load_typestore("ros1" if self.is_ros1 else "cdr")
        self._serialize = store.serialize_ros1 if self.is_ros1 else store.serialize_cdr

    def add_topic(self, name: str, type: str, *, latched: bool = False) -> Send:
        """Add a topic; returns a function that writes a message at a stamp in nanoseconds.

        Args:
            name: with its slash.
            type: as `sensor_msgs/msg/LaserScan`.
            latched: late subscribers still get the last message.
        """
        writer, serialize = self._writer, self._serialize
        connection = self._add_connection(name, type, latched, typestore=self._store)
        return lambda stamp, message: writer.write(connection, stamp, serialize(message, type))

    def copy_topic(self, channel: Channel) -> SendRaw | None:
        """Add a topic like one of another bag; returns a function that writes raw messages.

        None where the definition of its type is not known.
        """
        definition: dict[str, Any] = {"typestore": self._store}
        digest = channel.digest or _digest(channel)
        if channel.definition and digest:
            hash_name = "md5sum" if self.is_ros1 else "rihs01"
            definition = {"msgdef": channel.definition, hash_name: digest}
        elif channel.type not in self._store.fielddefs:
            return None
        writer = self._writer
        if self.is_ros1 and channel.publisher:
            definition["callerid"] = channel.publisher
        if not self.is_ros1 and channel.qos:
            definition["offered_qos_profiles"] = list(channel.qos)
        connection = self._add_connection(
            channel.topic, channel.type, channel.latched, **definition
        )
        return lambda stamp, raw: writer.write(connection, stamp, raw)

    def serialize(self, message: Any, type: str) -> bytes:
        """The bytes of a message in this kind of bag."""
        return bytes(self._serialize(message, type))

    def make(self, type: str, /, **fields: Any) -> Any:
        """A message or a part of one."""
        return self._store.types[type](**fields)

    def time(self, stamp_ns: int) -> Any:
        """A time; never negative."""
        sec, nanosec = divmod(stamp_ns, 10**9)
        return self.make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)

    def header(self, stamp_ns: int, frame: str) -> Any:
        """The header of a message."""
        seq = {"seq": 0} if self.is_ros1 else {}
        stamp = self.time(stamp_ns)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **seq)

    def _add_connection(self, topic: str, type: str, latched: bool, **options: Any) -> Any:
        if self.is_ros1:
            options = {"callerid": "/stillmap", "latching": int(latched), **options}
        else:
            options = {"offered_qos_profiles": [_TRANSIENT_LOCAL] if latched else [], **options}
        return self._writer.add_connection(topic, type, **options)


def _digest(channel: Channel) -> str:
    """The hash of a ROS 2 type from its definition; "" where that is missing or invalid."""
    if channel.encoding == "ros1" or not channel.definition:
        return ""
    store = get_typestore(Stores.EMPTY)
    try:
        store.register(get_types_from_msg(channel.definition, channel.type))
        return store.hash_rihs01(channel.type)
    except Exception:  # any error of rosbags about a text that is no definition
        return ""


@contextmanager
def new_bag(
    path: Path, kind: BagKind, *, overwrite: bool = False, mcap: bool = False
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
            work = stack.enter_context(atomic_folder(path, "metadata.yaml", overwrite))
        else:
            work = stack.enter_context(atomic_file(path))
        # rosbags refuses existing files; for ROS 2 it makes a folder, and names its files after it
        beside = stack.enter_context(temporary_folder(path))
        if kind == "bag":
            with _sqlite_errors(path), rosbag1.Writer(beside / "bag") as writer1:
                yield BagWriter(kind, writer1)
            os.replace(beside / "bag", work)
            return
        mcap |= kind == "mcap"
        plugin = rosbag2.StoragePlugin.MCAP if mcap else rosbag2.StoragePlugin.SQLITE3
        folder = beside / (shorten(resolve_output(path).name) if kind == "ros2" else "bag")
        writer2 = rosbag2.Writer(folder, version=_VERSION, storage_plugin=plugin)
        if mcap:
            compression = rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD
            writer2.set_compression(*compression)
        with _sqlite_errors(path), writer2:
            yield BagWriter(kind, writer2)
        if kind == "ros2":
            for file in folder.iterdir():
                shutil.move(file, work / file.name)
        else:
            shutil.move(folder / f"{folder.name}.{kind}", work)


def require_stamps(first_ns: int, last_ns: int, kind: BagKind) -> None:
    """Refuse stamps that such a bag cannot hold.

    Raises:
        InputError: they are negative or too late.
    """
    if first_ns < 0 or last_ns >= _MAX_SECONDS[kind] * 10**9:
        span = f"stamps from {first_ns / 1e9:.0f} to {last_ns / 1e9:.0f} s"
        hint = f"0 to {_MAX_SECONDS[kind]} s"
        raise InputError(f"{span} do not fit into a ROS bag", hint=hint)


@contextmanager
def _sqlite_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except sqlite3.Error as error:  # a full disk
        raise InputError(f"cannot be written: {error}", where=str(path)) from error
