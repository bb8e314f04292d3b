"""Messages from their bytes, by definitions of our own.

A bag brings definitions of its types; here they only have to agree with the known ones, for what a
file says is never made into code.
"""

from functools import cache
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from stillmap.io.ros.bag_types import ZSTD_MAGIC, Channel, Message
from stillmap.io.ros.limits import decompress_zstd

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
        Exception: whatever the library says of bytes that are no such message.
    """
    channel, raw = message.channel, message.raw
    store = load_typestore(channel.encoding)
    if channel.encoding == "ros1":
        return store.deserialize_ros1(raw, channel.type)
    if raw.startswith(ZSTD_MAGIC):  # packed one by one; others begin with a zero byte
        raw = decompress_zstd(raw)
    return store.deserialize_cdr(raw, channel.type)


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
    """The definitions of messages, by `ros1` or `cdr`."""
    if encoding != "ros1":
        return get_typestore(Stores.ROS2_HUMBLE)
    store = get_typestore(Stores.ROS1_NOETIC)
    for name in (TF, ROS1_TF):
        store.register(get_types_from_msg(_TF_DEFINITION, name))
    return store


@cache
def _digest(encoding: str, kind: str) -> str:
    store = load_typestore(encoding)
    return store.generate_msgdef(kind)[1] if encoding == "ros1" else store.hash_rihs01(kind)


def stamp_ns(header: Any) -> int:
    """The stamp of a header in nanoseconds."""
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def frame_name(name: Any) -> str:
    """A frame's name without the slash that old recordings write before it."""
    return str(name).removeprefix("/")
