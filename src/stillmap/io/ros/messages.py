"""Kinds of bags, their channels and messages, and decoding of bytes.

Definitions in a bag are only compared with the known ones, never turned into code. Detection of a
bag by its first bytes loads none of the libraries.
"""

import re
from collections import defaultdict
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from stillmap.core.input_files import InputFile
from stillmap.io.builder import SkippedRecords
from stillmap.io.text_lines import list_files

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

BagKind = Literal["bag", "ros2", "db3", "mcap"]

_STORAGE_ENDINGS = (".db3", ".mcap")
_COMPRESSED_ENDINGS = (".db3.zstd", ".mcap.zstd")
ENDINGS = (".bag", *_STORAGE_ENDINGS)
BAG1_MAGIC = b"#ROSBAG V"
MCAP_MAGIC = b"\x89MCAP0\r\n"
DB3_MAGIC = b"SQLite format 3\0"
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"

LASER_SCAN, MULTI_ECHO = "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/MultiEchoLaserScan"
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
SCAN_TYPES = (LASER_SCAN, MULTI_ECHO, POINT_CLOUD)
ODOMETRY = "nav_msgs/msg/Odometry"
TF, ROS1_TF = "tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"
IMAGE, COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"

UNREADABLE = "message that cannot be decoded"

_TF_DEFINITION = "geometry_msgs/TransformStamped[] transforms"


class DamagedBagError(Exception):
    """A bag turned out to be damaged or without its index."""


class Channel(NamedTuple):
    """One topic as one publisher wrote it.

    Attributes:
        id: within its bag.
        topic: name.
        type: of its messages, as `sensor_msgs/msg/LaserScan`.
        encoding: `ros1` or `cdr`.
        n_messages: number of messages.
        digest: hash of the type definition, "" where the bag has none.
        definition: text of the type definition, "" where the bag has none.
        latched: late subscribers still get the last message.
        publisher: name of the ROS 1 node that wrote it, "" where it is not known.
        qos: profiles that ROS 2 publishers offered, as rosbags has them.
    """

    id: int
    topic: str
    type: str
    encoding: str
    n_messages: int = 0
    digest: str = ""
    definition: str = ""
    latched: bool = False
    publisher: str = ""
    qos: tuple[Any, ...] = ()


class Message(NamedTuple):
    """One message: channel, log time in ns, content."""

    channel: Channel
    log_ns: int
    raw: bytes


SkippedByTopic = defaultdict[str, SkippedRecords]


def is_bag(path: Path, start: bytes | None) -> bool:
    """True if a file with these first bytes, or a folder (None), is a bag.

    The files of a folder must be one recording, which recorders split into X_0, X_1, ...
    """
    if start is not None:
        return start.startswith((BAG1_MAGIC, MCAP_MAGIC, DB3_MAGIC)) or is_compressed(path, start)
    files = storage_files(path)
    if (path / "metadata.yaml").is_file():
        return bool(files)
    return len({re.sub(r"_\d+$", "", file.name.partition(".")[0]) for file in files}) == 1


def is_compressed(path: Path, start: bytes) -> bool:
    """True if a file of a ROS 2 folder is compressed as a whole."""
    return path.name.endswith(_COMPRESSED_ENDINGS) and start.startswith(_ZSTD_MAGIC)


def detect_kind(path: Path) -> tuple[BagKind, bool]:
    """The kind of a bag, and whether it stores messages as MCAP."""
    if path.is_dir():
        return "ros2", any(".mcap" in file.name for file in storage_files(path))
    with InputFile(path) as file:
        start = file.read(len(DB3_MAGIC))
    if start.startswith(BAG1_MAGIC):
        return "bag", False
    is_mcap = ".mcap" in path.name or start.startswith(MCAP_MAGIC)
    return ("mcap", True) if is_mcap else ("db3", False)


def storage_files(folder: Path) -> list[Path]:
    """The files of a ROS 2 folder that hold messages, bag_2 before bag_10."""
    return list_files(folder, (*_STORAGE_ENDINGS, *_COMPRESSED_ENDINGS))


def decode(message: Message) -> Any:
    """The message as an object of its type.

    Raises:
        Exception: any error of rosbags about bytes that are no such message.
    """
    channel = message.channel
    store = load_typestore(channel.encoding)
    if channel.encoding == "ros1":
        return store.deserialize_ros1(message.raw, channel.type)
    return store.deserialize_cdr(decompress(message), channel.type)


def decompress(message: Message) -> bytes:
    """The content of a message, which ROS 2 may have compressed one by one."""
    # a CDR message begins with a zero byte
    if message.channel.encoding == "ros1" or not message.raw.startswith(_ZSTD_MAGIC):
        return message.raw
    from stillmap.io.ros import limits

    return limits.decompress("zstd", message.raw)


def find_fault(channel: Channel) -> str | None:
    """Why messages of a channel cannot be decoded, None if they can."""
    if channel.encoding not in ("ros1", "cdr"):
        return f"encoded as {channel.encoding!r}"
    if channel.type not in load_typestore(channel.encoding).fielddefs:
        return f"of unknown type {channel.type}"
    if channel.digest and channel.digest not in ("*", _digest(channel.encoding, channel.type)):
        return f"its {channel.type} is defined otherwise than here"
    return None


@cache
def load_typestore(encoding: str) -> "Typestore":
    """The message definitions of an encoding, `ros1` or `cdr`."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if encoding != "ros1":
        return get_typestore(Stores.ROS2_HUMBLE)
    store = get_typestore(Stores.ROS1_NOETIC)
    for name in (TF, ROS1_TF):  # missing in the store
        store.register(get_types_from_msg(_TF_DEFINITION, name))
    return store


@cache
def _digest(encoding: str, kind: str) -> str:
    store = load_typestore(encoding)
    return store.generate_msgdef(kind)[1] if encoding == "ros1" else store.hash_rihs01(kind)


def hash_definition(channel: Channel) -> str:
    """The hash of a ROS 2 type from its definition; "" where that is missing or invalid."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if channel.encoding == "ros1" or not channel.definition:
        return ""
    store = get_typestore(Stores.EMPTY)
    try:
        store.register(get_types_from_msg(channel.definition, channel.type))
        return store.hash_rihs01(channel.type)
    except Exception:  # any error of rosbags about a text that is no definition
        return ""


def stamp_ns(header: Any) -> int:
    """The stamp of a header in nanoseconds."""
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def frame_name(name: Any) -> str:
    """A frame without the leading slash of old recordings."""
    return str(name).removeprefix("/")
