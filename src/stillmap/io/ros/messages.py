"""Message types that are read, and decoding of their bytes.

Definitions in a bag are only compared with the known ones, never turned into code.
"""

import struct
from functools import cache
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from stillmap.io.ros import limits
from stillmap.io.ros.bag_types import ZSTD_MAGIC, Channel, Message

LASER_SCAN, MULTI_ECHO = "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/MultiEchoLaserScan"
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
ODOMETRY = "nav_msgs/msg/Odometry"
TF, ROS1_TF = "tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"
IMAGE, COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"

_TF_DEFINITION = "geometry_msgs/TransformStamped[] transforms"


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
    compressed = message.channel.encoding != "ros1" and message.raw.startswith(ZSTD_MAGIC)
    return limits.decompress("zstd", message.raw) if compressed else message.raw


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
def load_typestore(encoding: str) -> Typestore:
    """The message definitions of an encoding, `ros1` or `cdr`."""
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


def stamp_ns(header: Any) -> int:
    """The stamp of a header in nanoseconds."""
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def peek_stamp_ns(message: Message) -> int | None:
    """The stamp of the header that a message begins with, without decoding the rest.

    The log time where the header has none; None where the message is too short for one.
    """
    try:
        if message.channel.encoding == "ros1":
            seconds, rest = struct.unpack_from("<II", message.raw, 4)  # after the number
        else:
            raw = decompress(message)
            seconds, rest = struct.unpack_from("<iI" if raw[1] & 1 else ">iI", raw, 4)
    except (struct.error, IndexError):
        return None
    return int(seconds) * 10**9 + int(rest) or message.log_ns


def frame_name(name: Any) -> str:
    """A frame without the leading slash of old recordings."""
    return str(name).removeprefix("/")
