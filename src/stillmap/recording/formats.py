"""Which reader reads what: the one table of formats."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from stillmap.errors import InputError
from stillmap.recording import carmen, folder, limits
from stillmap.recording.carmen_messages import SCAN_PARSERS
from stillmap.recording.lines import Progress, head
from stillmap.recording.model import Recording
from stillmap.recording.options import ReadOptions

_HEAD = 1 << 16  # bytes looked at to tell what a file is


class Format(NamedTuple):
    """A format: suffixes of its files, whether first bytes look like it, its reader."""

    name: str
    suffixes: tuple[str, ...]
    sniff: Callable[[bytes], bool]
    read: Callable[[Path, ReadOptions, Progress | None], Recording]


def _looks_like_carmen(text: bytes) -> bool:
    words = {*SCAN_PARSERS, b"ODOM", b"PARAM"}
    first_words = (line.split(maxsplit=1)[:1] for line in text.splitlines())
    return any(word in words for first in first_words for word in first)


FORMATS = (
    Format(
        "CARMEN log",
        (".log", ".clf", ".txt", ".log.gz", ".clf.gz", ".txt.gz", ".gz"),
        _looks_like_carmen,
        carmen.read,
    ),
)


def read(
    path: str | Path, options: ReadOptions | None = None, *, progress: Progress | None = None
) -> Recording:
    """Read a recording, whatever its format.

    Args:
        path: a file (see `FORMATS`) or a folder with `recording.json`.
        options: how readings are understood, None for the defaults. Of a recording folder, whose
            readings are understood already, they narrow what is there.
        progress: called now and then with the share of the file that is read, 0 to 1.

    Raises:
        InputError: nothing there, or no recording that can be read.
    """
    path = Path(path)
    options = options or ReadOptions()
    try:
        is_folder, is_file = path.is_dir(), path.is_file()
    except (OSError, ValueError) as error:
        raise InputError(f"is no usable path: {error}", where=repr(str(path))) from error
    if is_folder and (path / folder.HEADER).is_file():
        return limits.applied(folder.read(path), options)
    if is_file and path.name == folder.HEADER:
        return limits.applied(folder.read(path.parent), options)
    if is_file:
        return _reader_of(path)(path, options, progress)
    if is_folder:
        raise InputError(f"is a folder without {folder.HEADER}", where=str(path), hint=_known())
    what = "is no regular file" if path.exists() else "does not exist"
    raise InputError(what, where=str(path), hint=_known())


def _reader_of(path: Path) -> Callable[[Path, ReadOptions, Progress | None], Recording]:
    """The reader for a file: by suffix, unless its content is plainly not text; else by content."""
    start = head(path, _HEAD)
    for known in FORMATS:
        if known.sniff(start):
            return known.read
    if path.stat().st_size == 0:
        raise InputError("is empty", where=str(path), hint=_known())
    if b"\0" in start:
        raise InputError(
            "is binary, no recording that stillmap reads", where=str(path), hint=_known()
        )
    name = path.name.lower()
    for known in FORMATS:
        if name.endswith(known.suffixes):
            return known.read
    raise InputError("is no recording that stillmap reads", where=str(path), hint=_known())


def _known() -> str:
    files = "; ".join(f"{f.name} ({', '.join(f.suffixes)})" for f in FORMATS)
    return f"stillmap reads: {files}; folders with {folder.HEADER}"
