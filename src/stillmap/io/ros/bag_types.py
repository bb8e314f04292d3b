"""Types shared by all bag formats (channels, raw messages), and format detection."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

from stillmap.core.errors import InputError
from stillmap.core.input_files import InputFile
from stillmap.core.timestamps import MAX_STAMP_NS
from stillmap.io.builder import SkippedRecords

BagKind = Literal["bag", "ros2", "db3", "mcap"]

ENDINGS = (".bag", ".db3", ".mcap")
BAG1_MAGIC = b"#ROSBAG V"
MCAP_MAGIC = b"\x89MCAP0\r\n"
DB3_MAGIC = b"SQLite format 3\0"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


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
    n_messages: int
    digest: str
    definition: str = ""
    latched: bool = False
    publisher: str = ""
    qos: tuple[Any, ...] = ()


class Message(NamedTuple):
    """One message: channel, log time in ns, content."""

    channel: Channel
    log_ns: int
    raw: bytes


class Bag(Protocol):
    """An open bag.

    Attributes:
        kind: readable name.
        channels: all channels.
        damage: unreadable parts by reason and byte position.
    """

    kind: str
    channels: list[Channel]
    damage: SkippedRecords

    def messages(self, topics: set[str], since_ns: int | None = None) -> Iterator[Message]:
        """Messages of these topics, roughly by log time; with `since_ns` no earlier ones.

        Raises:
            DamagedBagError: an indexed bag is damaged.
        """
        ...

    def close(self) -> None:
        """Close the files."""
        ...


def is_log_time(value: object) -> bool:
    """True for log times in ns: columns of SQLite are not typed."""
    return isinstance(value, int) and abs(value) <= MAX_STAMP_NS


def is_bag(path: Path, start: bytes | None) -> bool:
    """True if a file with these first bytes, or a folder (None), is a bag."""
    if start is None:
        return _is_bag_folder(path)
    return start.startswith((BAG1_MAGIC, MCAP_MAGIC, DB3_MAGIC)) or is_compressed(path, start)


def _is_bag_folder(path: Path) -> bool:
    """True if the files of a folder are one recording, which recorders split into X_0, X_1, ..."""
    files = storage_files(path)
    if (path / "metadata.yaml").is_file():
        return bool(files)
    return len({re.sub(r"_\d+$", "", file.name.partition(".")[0]) for file in files}) == 1


def is_compressed(path: Path, start: bytes) -> bool:
    """True if a file of a ROS 2 folder is compressed as a whole."""
    return path.name.endswith((".db3.zstd", ".mcap.zstd")) and start.startswith(ZSTD_MAGIC)


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
    """The files of a ROS 2 folder that hold messages, in natural order."""
    try:
        files = sorted(folder.iterdir(), key=_natural_order)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=str(folder)) from error
    return [f for f in files if f.name.removesuffix(".zstd").endswith((".db3", ".mcap"))]


def _natural_order(path: Path) -> list[tuple[int, str]]:
    """Sort key: bag_2 before bag_10."""
    digits = "".join(c if c.isdigit() else " " for c in path.name).split()
    return [(int(d[:18]), "") for d in digits] + [(0, path.name)]
