"""Limits on what a bag may expand to: a few bytes can claim to be terabytes.

Decompression stops at `MAX_CHUNK`, the output of a whole bag at a multiple of its size. A SQLite
file can hold views that never end, generated columns, and trees in which one page occurs a million
times: its tables have to be plain tables, and the steps that a query may take are bounded.
"""

import bz2
import os
import sqlite3
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any
from urllib.parse import quote

import apsw
import lz4.frame  # type: ignore[import-untyped]

from stillmap.core.errors import InputError
from stillmap.core.input_files import InputFile, require_regular

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MAX_CHUNK = 256 << 20  # bytes of one chunk or message; recorders write chunks of about one megabyte
RECORD_COST = 64  # bytes that a record counts for, even an empty one

_DECOMPRESSORS: dict[str, Callable[[], Any]] = {
    "bz2": bz2.BZ2Decompressor,
    "lz4": lz4.frame.LZ4FrameDecompressor,
    "zstd": zstd.ZstdDecompressor,
}
_MAX_RATIO, _MIN_LIMIT = 300, 512 << 20  # output of a bag: times its size; bytes
_TABLES = ("topics", "messages", "schema", "message_definitions")
_STEP_INTERVAL = 1000  # virtual machine steps between two calls of the progress handler
_STEPS_PER_BYTE = 30  # a row takes about 20 steps, and has at least as many bytes
_MIN_STEPS = 1_000_000  # a hundredth of a second


class OutputLimitError(InputError):
    """More data comes out of a file than can have been put in."""


_bytes_left: ContextVar[list[int] | None] = ContextVar("bytes_left", default=None)


@contextmanager
def limit_output(size: int) -> Iterator[None]:
    """Within this context a bag of `size` bytes yields no more than such a bag can hold.

    Its index may name one message a million times, and many small parts add up.
    """
    token = _bytes_left.set([max(_MAX_RATIO * size, _MIN_LIMIT)])
    try:
        yield
    finally:
        _bytes_left.reset(token)


def count_output(count: int) -> None:
    """Count bytes of output.

    Raises:
        OutputLimitError: the limit is exceeded.
    """
    left = _bytes_left.get()
    if left is None:
        return
    left[0] -= count
    if left[0] < 0:
        raise OutputLimitError(f"is damaged: it expands to more than {_MAX_RATIO} times its size")


def decompress(compression: str, data: bytes) -> bytes:
    """Decompress up to `MAX_CHUNK` bytes of a compression in `_DECOMPRESSORS`.

    Raises:
        InputError: there are more.
        Exception: any error of the library about damaged data.
    """
    count_output(0)
    out = bytes(_DECOMPRESSORS[compression]().decompress(data, MAX_CHUNK + 1))
    count_output(len(out))
    if len(out) > MAX_CHUNK:
        what = f"a compressed part is larger than {MAX_CHUNK >> 20} MiB"
        raise InputError(what, hint="a recording compressed in smaller chunks can be read")
    return out


def decompress_file(path: Path, out: Path) -> bool:
    """Decompress a file of zstd frames; False if only its beginning could be, as it is damaged.

    Raises:
        InputError: it becomes too large.
    """
    with InputFile(path) as source, zstd.open(source, "rb") as stream, out.open("wb") as file:
        limit = max(_MAX_RATIO * source.size, _MIN_LIMIT)
        try:
            while piece := stream.read(1 << 20):
                file.write(piece)
                if file.tell() > limit:
                    what = f"decompresses to more than {_MAX_RATIO} times its size"
                    raise InputError(what, where=str(path))
        except (zstd.ZstdError, EOFError):
            return False
    return True


def database_path(path: Path) -> str:
    """The path quoted for a SQLite URI, in which ?, # and % have a meaning."""
    return quote(os.path.realpath(os.fsencode(path)))


def open_database(path: Path) -> sqlite3.Connection:
    """Open a SQLite file for reading, with checked tables and bounded queries.

    Raises:
        sqlite3.Error: it cannot be read.
        InputError: a table is a view, a virtual table or has generated columns.
    """
    require_regular(path)
    database = sqlite3.connect(f"file:{database_path(path)}?immutable=1&mode=ro", uri=True)
    try:
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_CHUNK)
        database.set_progress_handler(_step_counter(path), _STEP_INTERVAL)
        query = "SELECT name, type, sql FROM sqlite_master WHERE name = ? COLLATE NOCASE"
        for table in _TABLES:
            for name, kind, sql in database.execute(query, (table,)).fetchall():
                plain = kind == "table" and str(sql).upper().startswith("CREATE TABLE")
                info = f"PRAGMA table_xinfo({table})"
                if not plain or any(column[-1] for column in database.execute(info).fetchall()):
                    raise InputError(f"is no bag: its {name} are no plain table")
    except BaseException:
        database.close()
        raise
    return database


@contextmanager
def limit_databases(path: Path) -> Iterator[None]:
    """Apply the limits of `open_database` to databases that rosbags opens in this context.

    Raises:
        sqlite3.Error, InputError: see `open_database`.
    """
    open_database(path).close()

    def limit(database: apsw.Connection) -> None:
        database.limit(apsw.SQLITE_LIMIT_LENGTH, MAX_CHUNK)
        database.set_progress_handler(_step_counter(path), _STEP_INTERVAL)

    apsw.connection_hooks.append(limit)
    try:
        yield
    finally:
        apsw.connection_hooks.remove(limit)


def _step_counter(path: Path) -> Callable[[], bool]:
    """A progress handler that returns True, which aborts the query, after too many steps."""
    left = _MIN_STEPS + _STEPS_PER_BYTE * path.stat().st_size

    def exceeded() -> bool:
        nonlocal left
        left -= _STEP_INTERVAL
        return left < 0

    return exceeded
