"""Which files and folders are bags: shown by their first bytes and names, without reading them."""

from pathlib import Path
from typing import Literal

from stillmap.errors import InputError

Kind = Literal["bag", "ros2", "db3", "mcap"]

BAG1_MAGIC = b"#ROSBAG V"
MCAP_MAGIC = b"\x89MCAP0\r\n"
DB3_MAGIC = b"SQLite format 3\0"
ENDINGS = (".bag", ".db3", ".mcap")
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


def is_bag(path: Path, start: bytes | None) -> bool:
    """Whether a file with these first bytes, or a folder (None), is a bag."""
    if start is None:
        return bool(storage_files(path))
    return start.startswith((BAG1_MAGIC, MCAP_MAGIC, DB3_MAGIC)) or is_packed(path, start)


def own_form(path: Path) -> tuple[Kind, bool]:
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


def is_packed(path: Path, start: bytes) -> bool:
    """Whether a file of a ROS 2 folder is packed as a whole."""
    return path.name.endswith((".db3.zstd", ".mcap.zstd")) and start.startswith(ZSTD_MAGIC)
