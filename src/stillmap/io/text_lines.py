"""Reads numbered lines of a text file, plain or gzip, damaged or not."""

import gzip
import re
import sys
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import IO, NamedTuple

from stillmap.core.errors import InputError
from stillmap.core.files import atomic_file
from stillmap.core.input_files import InputFile

MAX_LINE = 1 << 20  # bytes: a scan of 3600 readings with remissions has a tenth of it
_MAX_RATIO, _MIN_LIMIT = 100, 64 << 20  # size of a decompressed text: ratio (logs have 20), bytes
_LINE_COST = 32  # bytes that a line counts for in addition
_GZIP_MAGIC = b"\x1f\x8b"
_DAMAGED = (EOFError, zlib.error, gzip.BadGzipFile)

Progress = Callable[[float], None]


def share_progress(progress: Progress | None, number: int, count: int) -> Progress | None:
    """Progress within one of `count` inputs that are read one after the other."""
    if progress is None:
        return None
    return lambda share: progress((number + share) / count)


class Line(NamedTuple):
    """One line: its number from 1, and its bytes up to `MAX_LINE`.

    `ended` is False where the file stops without a line end, `damaged` True on a last empty line
    that stands for a broken gzip stream.
    """

    number: int
    text: bytes
    ended: bool = True
    too_long: bool = False
    damaged: bool = False


def is_gzip(path: Path) -> bool:
    """True if the content of a file is gzip."""
    with InputFile(path) as file:
        return file.read(2) == _GZIP_MAGIC


@contextmanager
def write_atomically(path: Path) -> Iterator[IO[bytes] | gzip.GzipFile]:
    """A new file, gzip by its name, which appears complete or not at all.

    Equal texts give equal bytes.
    """
    compressed = path.name.lower().endswith(".gz")
    with atomic_file(path) as work, work.open("wb") as file:
        if not compressed:
            yield file
            return
        # neither name nor time; level 6 is far faster than 9 for a tenth more bytes
        with gzip.GzipFile("", "wb", 6, fileobj=file, mtime=0) as stream:
            yield stream


def read_head(path: Path, size: int) -> bytes:
    """The first `size` bytes of a text, decompressed if gzip, fewer if damaged."""
    with InputFile(path) as file:
        compressed = file.read(2) == _GZIP_MAGIC
        file.seek(0)
        if not compressed:
            return file.read(size)
        # wbits 31: gzip container
        try:
            return zlib.decompressobj(31).decompress(file.read(size), size)
        except zlib.error:
            return b""


def read_lines(path: Path, progress: Progress | None = None) -> Iterator[Line]:
    """Read a file line by line.

    Raises:
        InputError: the file cannot be opened or read.
    """
    with InputFile(path) as file:
        size = max(file.size, 1)
        compressed = file.read(2) == _GZIP_MAGIC
        file.seek(0)
        stream = gzip.GzipFile(fileobj=file, mode="rb") if compressed else file
        number = size_read = 0
        limit = max(_MAX_RATIO * size, _MIN_LIMIT) if compressed else sys.maxsize
        try:
            while text := stream.readline(MAX_LINE):
                number += 1
                size_read += len(text) + _LINE_COST
                ended = text.endswith(b"\n")
                too_long = not ended and len(text) == MAX_LINE
                if too_long:
                    size_read += _skip_rest(stream, limit - size_read)
                if size_read > limit:
                    what = f"is too large: it decompresses to more than {_MAX_RATIO} times its size"
                    hint = "decompress it first"
                    raise InputError(what, where=str(path), hint=hint)
                yield Line(number, text, ended, too_long)
                if progress is not None and number % 500 == 0:
                    progress(min(file.tell() / size, 1.0))
        except _DAMAGED:
            yield Line(number + 1, b"", damaged=True)
        except OSError as error:
            raise InputError(f"cannot be read: {error.strerror}", where=str(path)) from error


def _skip_rest(stream: IO[bytes] | gzip.GzipFile, limit: int) -> int:
    """Skip to the end of the line, or a little beyond `limit` bytes; returns the number skipped."""
    skipped = 0
    while skipped <= limit and (rest := stream.readline(MAX_LINE)):
        skipped += len(rest)
        if rest.endswith(b"\n"):
            break
    return skipped


def replace_words(line: bytes, words: Mapping[int, bytes]) -> bytes:
    """A line with the words of some numbers, from 0, replaced; all else stays."""
    number = count()
    return re.sub(rb"\S+", lambda found: words.get(next(number), found[0]), line)
