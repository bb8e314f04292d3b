"""Numbered lines of a text file, plain or gzip, whatever the state it is in."""

import gzip
import sys
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, NamedTuple

from stillmap.core.errors import InputError

MAX_LINE = 1 << 20  # bytes: a scan of 3600 readings with remissions has a tenth of it
# of a packed text: times its size, bytes; logs pack 20:1. A line counts for more than its bytes
_MAX_GROWTH, _SURELY_FINE, _LINE = 100, 64 << 20, 32
_GZIP_MAGIC = b"\x1f\x8b"
_DAMAGED = (EOFError, zlib.error, gzip.BadGzipFile)

Progress = Callable[[float], None]


class Line(NamedTuple):
    """One line: its number from 1, its bytes, and what is wrong with it as a line.

    `text` is cut at `MAX_LINE` where the line is longer. `ended` is False where the file stops
    without a line end, `damaged` True on a last empty line that stands for a broken gzip stream.
    """

    number: int
    text: bytes
    ended: bool = True
    too_long: bool = False
    damaged: bool = False


def is_gzip(path: Path) -> bool:
    """Whether the file starts as gzip does; its name plays no part."""
    with _open(path) as file:
        return file.read(2) == _GZIP_MAGIC


def is_gzip_name(path: Path) -> bool:
    """Whether a file of this name is to be written as gzip."""
    return path.name.lower().endswith(".gz")


@contextmanager
def open_for_writing(path: Path, *, packed: bool) -> Iterator[IO[bytes] | gzip.GzipFile]:
    """A new file of bytes, gzip if `packed`; equal texts give equal bytes."""
    with path.open("wb") as file:
        if not packed:
            yield file
            return
        # neither name nor time; a tenth larger than at Python's level 9, in a fraction of the time
        with gzip.GzipFile("", "wb", 6, fileobj=file, mtime=0) as stream:
            yield stream


def read_head(path: Path, size: int) -> bytes:
    """The first `size` bytes of the text, unpacked where it is gzip, fewer where it is damaged."""
    with _open(path) as file:
        packed = file.read(2) == _GZIP_MAGIC
        file.seek(0)
        if not packed:
            return file.read(size)
        # wbits 31: gzip container; a cut stream gives what it has
        try:
            return zlib.decompressobj(31).decompress(file.read(size), size)
        except zlib.error:
            return b""


def read_lines(path: Path, progress: Progress | None = None) -> Iterator[Line]:
    """Every line of the file, read as a stream.

    Raises:
        InputError: the file cannot be opened or read.
    """
    with _open(path) as file:
        size = max(path.stat().st_size, 1)
        packed = file.read(2) == _GZIP_MAGIC
        file.seek(0)
        stream = gzip.GzipFile(fileobj=file, mode="rb") if packed else file
        number = unpacked = 0
        most = max(_MAX_GROWTH * size, _SURELY_FINE) if packed else sys.maxsize
        try:
            while text := stream.readline(MAX_LINE):
                number += 1
                unpacked += len(text) + _LINE
                ended = text.endswith(b"\n")
                too_long = not ended and len(text) == MAX_LINE
                if too_long:
                    unpacked += _skip_rest(stream, most - unpacked)
                if unpacked > most:
                    what = f"is too large: it unpacks to more than {_MAX_GROWTH} times its size"
                    hint = "it can be read if it is unpacked before"
                    raise InputError(what, where=str(path), hint=hint)
                yield Line(number, text, ended, too_long)
                if progress is not None and number % 500 == 0:
                    progress(min(file.tell() / size, 1.0))
        except _DAMAGED:
            yield Line(number + 1, b"", damaged=True)
        except OSError as error:
            raise InputError(f"cannot be read: {error.strerror}", where=str(path)) from error


def _skip_rest(stream: IO[bytes] | gzip.GzipFile, most: int) -> int:
    """Reads to the end of the line, or a little more than `most` bytes; how many it read."""
    skipped = 0
    while skipped <= most and (rest := stream.readline(MAX_LINE)):
        skipped += len(rest)
        if rest.endswith(b"\n"):
            break
    return skipped


def _open(path: Path) -> IO[bytes]:
    try:
        return path.open("rb")
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=str(path)) from error
