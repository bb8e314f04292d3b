"""Opens bags of every kind; which kind shows in their first bytes."""

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import yaml

from stillmap.core.errors import InputError
from stillmap.core.files import require_regular
from stillmap.io.builder import SkippedRecords
from stillmap.io.ros import damaged_bag, indexed_bag
from stillmap.io.ros.bag_types import (
    BAG1_MAGIC,
    DB3_MAGIC,
    MCAP_MAGIC,
    Bag,
    Channel,
    DamagedBagError,
    Message,
    is_compressed,
    storage_files,
)
from stillmap.io.ros.limits import ZstdError, open_zstd

_MAX_GROWTH, _SURELY_FINE = 100, 1 << 30  # of a packed file: times its size, bytes
_MAX_METADATA = 256 << 10  # bytes: YAML takes two seconds for them
_PIECE = 1 << 20


def open_bag(path: Path, scratch: Path | None, *, trusted: bool) -> Bag:
    """Open a bag.

    Args:
        path: a file or a folder of files.
        scratch: folder for files that have to be unpacked; None: the system's.
        trusted: read with the index; else from the front, as far as it goes.

    Raises:
        DamagedError: `trusted`, and the bag is not indexed_bag.
        InputError: no bag that can be read at all.
    """
    if not path.is_dir():
        return _open_file(path, scratch, trusted)
    files = _list_files(path)
    bags: list[Bag] = []
    try:
        for file in files:
            bags.append(_open_file(file, scratch, trusted))
    except BaseException:
        for bag in bags:
            bag.close()
        raise
    return _JoinedBag(bags)


def bag_size(path: Path) -> int:
    """Bytes of a bag, or of all files of a folder."""
    files = _list_files(path) if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files)


def _open_file(path: Path, scratch: Path | None, trusted: bool) -> Bag:
    require_regular(path)
    try:
        with path.open("rb") as file:
            start = file.read(32)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=str(path)) from error
    if is_compressed(path, start):
        return _CompressedBag(path, scratch, trusted)
    reader = indexed_bag if trusted else damaged_bag
    openers: dict[bytes, Callable[[Path], Bag]] = {
        b"#ROSBAG V2.0\n": reader.open_bag1,
        MCAP_MAGIC: reader.open_mcap,
        DB3_MAGIC: reader.open_db3,
    }
    for magic, opener in openers.items():
        if start.startswith(magic):
            return _opened(opener, path)
    if start.startswith(BAG1_MAGIC):
        version = start[8:13].decode("ascii", "replace").strip()
        hint = "`rosbag fix` or `rosbag reindex` of ROS 1 makes a V2.0 of it"
        raise InputError(f"is a bag of version {version}", where=str(path), hint=hint)
    raise InputError("is no bag, in spite of its name", where=str(path))


def _opened(opener: Callable[[Path], Bag], path: Path) -> Bag:
    try:
        return opener(path)
    except InputError as error:
        raise InputError(error.what, where=str(path), hint=error.hint) from error
    except PermissionError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=str(path)) from error
    except Exception as error:  # whatever a library makes of damaged bytes
        raise DamagedBagError(str(error) or type(error).__name__) from error


def _list_files(folder: Path) -> list[Path]:
    """The files of a ROS 2 folder in their order; `metadata.yaml` need not be there."""
    there = storage_files(folder)
    try:
        file = folder / "metadata.yaml"
        fine = file.is_file() and file.stat().st_size <= _MAX_METADATA
        text = file.read_text("utf-8") if fine else ""
        named = yaml.safe_load(text)["rosbag2_bagfile_information"]["relative_file_paths"]
        # a list in a list in a list is short as YAML, and has no end as text
        paths = [folder / Path(name).name for name in named if isinstance(name, str)]
    except (OSError, ValueError, LookupError, TypeError, RecursionError, yaml.YAMLError):
        return there
    missing = [path.name for path in paths if path not in there]
    if missing:
        raise InputError(
            f"lacks the file {missing[0]!r} that its metadata.yaml names",
            where=str(folder),
            hint="without metadata.yaml the files that are there are read",
        )
    return paths or there


class _JoinedBag:
    """Several files as one bag."""

    def __init__(self, bags: list[Bag]) -> None:
        self._bags = bags
        self.damage = SkippedRecords().merge(*(bag.damage for bag in bags))
        self.kind = f"ROS 2 folder ({bags[0].kind})"
        together: dict[tuple[str, str, str, str], Channel] = {}
        for bag in bags:
            for channel in bag.channels:
                key = _identity(channel)
                first = together.get(key, channel._replace(id=len(together), n_messages=0))
                together[key] = first._replace(n_messages=first.n_messages + channel.n_messages)
        self._channels = together
        self.channels = list(together.values())

    def messages(self, topics: set[str], since_ns: int | None = None) -> Iterator[Message]:
        for bag in self._bags:
            for message in bag.messages(topics, since_ns):
                yield message._replace(channel=self._channels[_identity(message.channel)])

    def close(self) -> None:
        for bag in self._bags:
            bag.close()


def _identity(channel: Channel) -> tuple[str, str, str, str]:
    return channel.topic, channel.type, channel.encoding, channel.digest


class _CompressedBag:
    """A file that was packed as a whole: unpacked into a folder that goes when it is closed."""

    def __init__(self, path: Path, scratch: Path | None, trusted: bool) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix=".stillmap-", dir=scratch)
        try:
            file = Path(self._folder.name) / path.name.removesuffix(".zstd")
            cut = _decompress(path, file)
            self._bag = _open_file(file, scratch, trusted and not cut)
        except BaseException:
            self._folder.cleanup()
            raise
        self.kind, self.channels, self.damage = (
            f"{self._bag.kind}, packed",
            self._bag.channels,
            self._bag.damage,
        )

    def messages(self, topics: set[str], since_ns: int | None = None) -> Iterator[Message]:
        return self._bag.messages(topics, since_ns)

    def close(self) -> None:
        self._bag.close()
        self._folder.cleanup()


def _decompress(path: Path, out: Path) -> bool:
    """Unpack a file; whether the stream was cut or damaged, so that only its beginning is there."""
    limit = max(_MAX_GROWTH * path.stat().st_size, _SURELY_FINE)
    written = 0
    with path.open("rb") as packed, open_zstd(packed) as stream, out.open("wb") as file:
        try:
            while piece := stream.read(_PIECE):
                written += len(piece)
                if written > limit:
                    raise InputError(
                        f"unpacks to more than {_MAX_GROWTH} times its size", where=str(path)
                    )
                file.write(piece)
        except (ZstdError, EOFError):
            return True
    return False
