"""Opens bags of every kind, detected by their first bytes."""

import tempfile
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import yaml

from stillmap.core.errors import InputError
from stillmap.core.input_files import InputFile, read_text
from stillmap.io.builder import SkippedRecords
from stillmap.io.parts.repeats import RepeatFilter
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
from stillmap.io.ros.damaged_bag import DamagedBag
from stillmap.io.ros.indexed_bag import IndexedBag
from stillmap.io.ros.limits import ZstdError, open_zstd

_STORAGES = {  # first bytes: name, opener of the reader with an index, recovery without
    b"#ROSBAG V2.0\n": ("ROS 1 bag", indexed_bag.open_bag1, damaged_bag.scan_bag1),
    MCAP_MAGIC: ("MCAP", indexed_bag.open_mcap, damaged_bag.scan_mcap),
    DB3_MAGIC: ("SQLite bag", indexed_bag.open_db3, damaged_bag.scan_db3),
}
_MAX_RATIO, _MIN_LIMIT = 100, 1 << 30  # of a compressed file: times its size; bytes
_MAX_METADATA = 256 << 10  # bytes of YAML, which take two seconds to parse
_PIECE = 1 << 20  # bytes


def open_bag(path: Path, scratch: Path | None, *, trusted: bool) -> Bag:
    """Open a bag.

    Args:
        path: a file or a folder of files.
        scratch: folder for files that have to be decompressed; None: the system's.
        trusted: read with the index; else recover what is there, from the front.

    Raises:
        DamagedBagError: `trusted`, and the bag is damaged or has no index.
        InputError: no readable bag.
    """
    if not path.is_dir():
        return _open_file(path, scratch, trusted)
    bags = _open_all(_list_files(path), partial(_open_file, scratch=scratch, trusted=trusted))
    return JoinedBag(bags, f"ROS 2 folder ({bags[0].kind})")


def open_parts(paths: Sequence[Path], scratch: Path | None, *, trusted: bool) -> Bag:
    """Open the parts of one run as one bag, in which no message comes twice.

    Args:
        paths: in order of time; see `open_bag` for the rest.

    Raises:
        DamagedBagError, InputError: see `open_bag`.
    """
    if len(paths) == 1:
        return open_bag(paths[0], scratch, trusted=trusted)
    bags = _open_all(paths, partial(open_bag, scratch=scratch, trusted=trusted))
    return JoinedBag(bags, ", ".join(dict.fromkeys(bag.kind for bag in bags)), repeats=True)


def _open_all(paths: Sequence[Path], open_one: Callable[[Path], Bag]) -> list[Bag]:
    bags: list[Bag] = []
    try:
        for path in paths:
            bags.append(open_one(path))
    except BaseException:
        for bag in bags:
            bag.close()
        raise
    return bags


def bag_size(path: Path) -> int:
    """Bytes of a bag, or of all files of a folder."""
    files = _list_files(path) if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files)


def _open_file(path: Path, scratch: Path | None, trusted: bool) -> Bag:
    with InputFile(path) as file:
        start = file.read(32)
    if is_compressed(path, start):
        return _CompressedBag(path, scratch, trusted)
    for magic, (kind, open_indexed, scan) in _STORAGES.items():
        if start.startswith(magic):
            try:
                if trusted:
                    return IndexedBag(kind, open_indexed(path))
                return DamagedBag(kind, partial(scan, path))
            except InputError as error:
                raise InputError(error.what, where=str(path), hint=error.hint) from error
            except PermissionError as error:
                raise InputError(f"cannot be read: {error.strerror}", where=str(path)) from error
            except Exception as error:  # any error of a library about damaged bytes
                raise DamagedBagError(str(error) or type(error).__name__) from error
    if start.startswith(BAG1_MAGIC):
        version = start[8:13].decode("ascii", "replace").strip()
        hint = "`rosbag fix` or `rosbag reindex` of ROS 1 makes a V2.0 of it"
        raise InputError(f"is a bag of version {version}", where=str(path), hint=hint)
    raise InputError("is no bag, in spite of its name", where=str(path))


def _list_files(folder: Path) -> list[Path]:
    """The files of a ROS 2 folder in the order of `metadata.yaml`, if there is one."""
    present = storage_files(folder)
    try:
        about = yaml.safe_load(read_text(folder / "metadata.yaml", _MAX_METADATA))
        names = about["rosbag2_bagfile_information"]["relative_file_paths"]
        # YAML aliases can nest lists without end
        paths = [folder / Path(name).name for name in names if isinstance(name, str)]
    except (InputError, ValueError, LookupError, TypeError, RecursionError, yaml.YAMLError):
        return present
    missing = [path.name for path in paths if path not in present]
    if missing:
        what = f"lacks the file {missing[0]!r} that its metadata.yaml names"
        hint = "without metadata.yaml the files that are there are read"
        raise InputError(what, where=str(folder), hint=hint)
    return paths or present


class JoinedBag:
    """Several bags as one; equal channels become one.

    Args:
        bags: in order of time.
        kind: readable name.
        repeats: whether a bag may begin with messages of the one before, which are left out.

    Attributes:
        repeated: number of messages that `messages` has left out so far.
    """

    def __init__(self, bags: list[Bag], kind: str, *, repeats: bool = False) -> None:
        self._bags, self._repeats = bags, repeats
        self.damage = SkippedRecords().merge(*(bag.damage for bag in bags))
        self.kind = kind
        self.repeated = 0
        self._channels: dict[tuple[str, str, str, str], Channel] = {}
        for bag in bags:
            for channel in bag.channels:
                key = _identity(channel)
                new = channel._replace(id=len(self._channels), n_messages=0)
                first = self._channels.get(key, new)
                n_messages = first.n_messages + channel.n_messages
                self._channels[key] = first._replace(n_messages=n_messages)
        self.channels = list(self._channels.values())

    def messages(self, topics: set[str], since_ns: int | None = None) -> Iterator[Message]:
        """See `Bag`."""
        known = RepeatFilter()
        for bag in self._bags:
            known.begin_part()
            for message in bag.messages(topics, since_ns):
                channel = self._channels[_identity(message.channel)]
                content = channel.topic.encode(), b"\0", message.raw
                if self._repeats and known.is_repeated(message.log_ns, *content):
                    self.repeated += 1
                    continue
                yield message._replace(channel=channel)

    def close(self) -> None:
        """See `Bag`."""
        for bag in self._bags:
            bag.close()


def _identity(channel: Channel) -> tuple[str, str, str, str]:
    return channel.topic, channel.type, channel.encoding, channel.digest


class _CompressedBag:
    """A file compressed as a whole, decompressed into a folder that lives until `close`."""

    def __init__(self, path: Path, scratch: Path | None, trusted: bool) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix=".stillmap-", dir=scratch)
        try:
            file = Path(self._folder.name) / path.name.removesuffix(".zstd")
            is_whole = _decompress(path, file)
            self._bag = _open_file(file, scratch, trusted and is_whole)
        except BaseException:
            self._folder.cleanup()
            raise
        self.kind = f"{self._bag.kind}, compressed"
        self.channels, self.damage = self._bag.channels, self._bag.damage
        self.messages = self._bag.messages

    def close(self) -> None:
        self._bag.close()
        self._folder.cleanup()


def _decompress(path: Path, out: Path) -> bool:
    """Decompress a file; False if the stream is damaged, so that only its beginning is there."""
    written = 0
    with InputFile(path) as compressed, open_zstd(compressed) as stream, out.open("wb") as file:
        limit = max(_MAX_RATIO * compressed.size, _MIN_LIMIT)
        try:
            while piece := stream.read(_PIECE):
                written += len(piece)
                if written > limit:
                    what = f"decompresses to more than {_MAX_RATIO} times its size"
                    raise InputError(what, where=str(path))
                file.write(piece)
        except (ZstdError, EOFError):
            return False
    return True
