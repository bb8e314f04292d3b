"""What bags of all kinds have in common: channels with messages as bytes.

Which files and folders are bags: shown by their first bytes and names, without reading them.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Literal, NamedTuple, Protocol

from stillmap.core.errors import InputError
from stillmap.io.builder import SkippedRecords

BagKind = Literal["bag", "ros2", "db3", "mcap"]

MAX_STAMP_NS = 2**63 - 1  # times of recording are counted in 64 bits


class DamagedBagError(Exception):
    """A bag turned out not to be whole."""


class Channel(NamedTuple):
    """One topic as one publisher wrote it.

    Attributes:
        id: within its bag.
        topic: its name.
        type: of its messages, as `sensor_msgs/msg/LaserScan`.
        encoding: `ros1` or `cdr`.
        n_messages: how many there are.
        digest: of the type's definition, "" where the bag has none.
        definition: of the type in words, "" where the bag has none.
        latched: whether who listens late still gets the last message.
    """

    id: int
    topic: str
    type: str
    encoding: str
    n_messages: int
    digest: str
    definition: str = ""
    latched: bool = False


class Message(NamedTuple):
    """One message: where it belongs, when it was recorded, and its bytes."""

    channel: Channel
    log_ns: int
    raw: bytes


class Bag(Protocol):
    """A bag that is open.

    Attributes:
        kind: for people.
        channels: what is in it.
        damage: what could not be read, by reason; numbers are byte positions.
    """

    kind: str
    channels: list[Channel]
    damage: SkippedRecords

    def messages(self, topics: set[str], since_ns: int | None = None) -> Iterator[Message]:
        """Messages on these topics, about in the order of their recording.

        Args:
            topics: their names.
            since_ns: only those recorded then or later; None: all.

        Raises:
            DamagedError: what was taken for whole is not.
        """
        ...

    def close(self) -> None:
        """Let the files go."""
        ...


BAG1_MAGIC = b"#ROSBAG V"

MCAP_MAGIC = b"\x89MCAP0\r\n"

DB3_MAGIC = b"SQLite format 3\0"

ENDINGS = (".bag", ".db3", ".mcap")

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


def is_bag(path: Path, start: bytes | None) -> bool:
    """Whether a file with these first bytes, or a folder (None), is a bag."""
    if start is None:
        return bool(storage_files(path))
    return start.startswith((BAG1_MAGIC, MCAP_MAGIC, DB3_MAGIC)) or is_compressed(path, start)


def detect_kind(path: Path) -> tuple[BagKind, bool]:
    """What kind of bag a path is, and whether MCAP files are in it."""
    if path.is_dir():
        return "ros2", any(".mcap" in file.name for file in storage_files(path))
    with path.open("rb") as file:
        start = file.read(len(DB3_MAGIC))
    if start.startswith(BAG1_MAGIC):
        return "bag", False
    return (
        ("mcap", True) if ".mcap" in path.name or start.startswith(MCAP_MAGIC) else ("db3", False)
    )


def storage_files(folder: Path) -> list[Path]:
    """The files of a ROS 2 folder that hold messages, in their order."""
    try:
        names = sorted(folder.iterdir(), key=_natural)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=str(folder)) from error
    return [f for f in names if f.name.removesuffix(".zstd").endswith((".db3", ".mcap"))]


def _natural(path: Path) -> list[tuple[int, str]]:
    """bag_2 before bag_10."""
    digits = "".join(c if c.isdigit() else " " for c in path.name).split()
    return [(int(d[:18]), "") for d in digits] + [(0, path.name)]


def is_compressed(path: Path, start: bytes) -> bool:
    """Whether a file of a ROS 2 folder is packed as a whole."""
    return path.name.endswith((".db3.zstd", ".mcap.zstd")) and start.startswith(ZSTD_MAGIC)
