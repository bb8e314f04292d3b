"""A new ROS bag of any kind, written message by message."""

import shutil
import sqlite3
import tempfile
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
from rosbags.typesys.store import Typestore

from stillmap.core.errors import InputError
from stillmap.core.files import atomic_file, atomic_folder
from stillmap.io.ros.bag_types import BagKind, Channel

Send = Callable[[int, Any], None]

# the oldest form that says what its messages are made of: ROS 2 before Jazzy reads no newer one
_VERSION: Literal[8] = 8
_SECONDS = {"bag": 1 << 32, "ros2": 1 << 31, "db3": 1 << 31, "mcap": 1 << 31}  # that stamps hold
_EVER = QosTime(9223372036, 854775807)
_TRANSIENT = Qos(
    QosHistory.KEEP_LAST,
    1,
    QosReliability.RELIABLE,
    QosDurability.TRANSIENT_LOCAL,
    _EVER,
    _EVER,
    QosLiveliness.AUTOMATIC,
    _EVER,
    False,
)


class BagWriter:
    """A bag that is being written.

    Args:
        kind: what it is.
        writer: of rosbags, open.
    """

    def __init__(self, kind: BagKind, writer: rosbag1.Writer | rosbag2.Writer) -> None:
        self._kind, self._writer = kind, writer
        self._store = _store(kind)

    def add_topic(self, name: str, type: str, *, latched: bool = False) -> Send:
        """A new topic: a function that sends a message at a stamp in nanoseconds.

        Args:
            name: with its slash.
            type: `sensor_msgs/msg/LaserScan`.
            latched: whoever listens later still gets the last message.
        """
        if isinstance(self._writer, rosbag1.Writer):
            return self._topic1(self._writer, name, type, latched)
        return self._topic2(self._writer, name, type, latched)

    def copy_topic(self, channel: Channel) -> Callable[[int, bytes], None] | None:
        """A topic like one of another bag: a function that sends bytes at a time in nanoseconds.

        None where nobody knows what its messages are made of.
        """
        digest = channel.digest or _digest(channel)
        if not (channel.definition and digest) and channel.type not in self._store.fielddefs:
            return None
        hashed = "md5sum" if isinstance(self._writer, rosbag1.Writer) else "rihs01"
        about: dict[str, Any] = (
            {"msgdef": channel.definition, hashed: digest}
            if channel.definition and digest
            else {"typestore": self._store}
        )
        if isinstance(self._writer, rosbag1.Writer):
            about |= {"callerid": "/stillmap", "latching": int(channel.latched)}
        else:
            about |= {"offered_qos_profiles": [_TRANSIENT] if channel.latched else []}
        connection = self._writer.add_connection(channel.topic, channel.type, **about)
        writer = self._writer
        return lambda stamp, raw: writer.write(connection, stamp, raw)

    def serialize(self, message: Any, type: str) -> bytes:
        """A message as the bytes of this kind of bag."""
        pack = self._store.serialize_ros1 if self.is_ros1 else self._store.serialize_cdr
        return bytes(pack(message, type))

    def make(self, type: str, /, **fields: Any) -> Any:
        """A message or a part of one."""
        return self._store.types[type](**fields)

    def time(self, stamp_ns: int) -> Any:
        """A time; never negative."""
        sec, nanosec = divmod(stamp_ns, 10**9)
        return self.make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)

    def header(self, stamp_ns: int, frame: str) -> Any:
        """The header of a message."""
        numbered = {"seq": 0} if self._kind == "bag" else {}
        stamp = self.time(stamp_ns)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **numbered)

    @property
    def is_ros1(self) -> bool:
        return self._kind == "bag"

    def _topic1(self, writer: rosbag1.Writer, name: str, type: str, latched: bool) -> Send:
        connection = writer.add_connection(
            name, type, typestore=self._store, callerid="/stillmap", latching=int(latched)
        )
        serialize = self._store.serialize_ros1
        return lambda stamp, message: writer.write(connection, stamp, serialize(message, type))

    def _topic2(self, writer: rosbag2.Writer, name: str, type: str, latched: bool) -> Send:
        qos = [_TRANSIENT] if latched else []
        connection = writer.add_connection(
            name, type, typestore=self._store, offered_qos_profiles=qos
        )
        serialize = self._store.serialize_cdr
        return lambda stamp, message: writer.write(connection, stamp, serialize(message, type))


def _digest(channel: Channel) -> str:
    """The hash of a ROS 2 type from its definition; "" where that cannot be understood."""
    if channel.encoding == "ros1" or not channel.definition:
        return ""
    store = get_typestore(Stores.EMPTY)
    try:
        store.register(get_types_from_msg(channel.definition, channel.type))
        return store.hash_rihs01(channel.type)
    except Exception:  # whatever the library makes of a text that is no definition
        return ""


@contextmanager
def new_bag(
    path: Path, kind: BagKind, *, overwrite: bool = False, mcap: bool = False
) -> Iterator[BagWriter]:
    """A bag that lies at `path` once the block ends without an exception.

    Args:
        path: a file, or the folder of kind "ros2".
        kind: ROS 1 `bag`; `ros2`, a folder with `metadata.yaml`; its file alone: `db3` or `mcap`.
        overwrite: replace the folder that is there; a file is replaced in any case.
        mcap: the file in a folder of kind "ros2" is an MCAP file.

    Raises:
        InputError: it cannot be written.
    """
    with ExitStack() as stack:
        if kind == "ros2":
            work = stack.enter_context(atomic_folder(path, "metadata.yaml", overwrite))
        else:
            work = stack.enter_context(atomic_file(path))
        if kind == "bag":
            work.unlink(missing_ok=True)  # of one that was killed: the writer refuses what is there
            with _told(path), rosbag1.Writer(work) as writer1:
                yield BagWriter(kind, writer1)
            return
        # a ROS 2 writer makes a folder of its own, and names its files after it
        inside = stack.enter_context(_scratch(path))
        mcap |= kind == "mcap"
        plugin = rosbag2.StoragePlugin.MCAP if mcap else rosbag2.StoragePlugin.SQLITE3
        named = inside / (path.stem if kind != "ros2" else path.name)
        writer2 = rosbag2.Writer(named, version=_VERSION, storage_plugin=plugin)
        if mcap:
            compression = rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD
            writer2.set_compression(*compression)
        with _told(path), writer2:
            yield BagWriter(kind, writer2)
        if kind == "ros2":
            for file in named.iterdir():
                shutil.move(file, work / file.name)
        else:
            shutil.move(named / f"{named.name}.{kind}", work)


def require_stamps(first_ns: int, last_ns: int, kind: BagKind) -> None:
    """Refuses stamps that such a bag cannot hold.

    Raises:
        InputError: they are negative or too late.
    """
    if first_ns < 0 or last_ns >= _SECONDS[kind] * 10**9:
        raise InputError(
            f"stamps from {first_ns / 1e9:.0f} to {last_ns / 1e9:.0f} s do not fit into a ROS bag",
            hint=f"0 to {_SECONDS[kind]} s",
        )


def _store(kind: BagKind) -> Typestore:
    if kind != "bag":
        return get_typestore(Stores.ROS2_HUMBLE)
    store = get_typestore(Stores.ROS1_NOETIC)
    # of the usual messages the one that rosbags does not have
    text = "geometry_msgs/TransformStamped[] transforms\n"
    store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
    return store


@contextmanager
def _scratch(path: Path) -> Iterator[Path]:
    """A folder beside `path`, on the same disk, gone at the end."""
    where = path.absolute().parent
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", suffix=".part", dir=where) as name:
        yield Path(name)


@contextmanager
def _told(path: Path) -> Iterator[None]:
    try:
        yield
    except sqlite3.Error as error:  # a full disk
        raise InputError(f"cannot be written: {error}", where=str(path)) from error
