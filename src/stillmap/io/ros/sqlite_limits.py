"""SQLite files of ROS 2, opened so that what they hold cannot run away with us.

A file can bring views that never end, columns that are computed, and trees of pages in which one
page stands a million times. Tables have to be tables, and the work that they make is bounded.
"""

import os
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import quote

import apsw

from stillmap.core.errors import InputError
from stillmap.io.ros.limits import MAX_CHUNK

_TABLES = ("topics", "messages", "schema", "message_definitions")
_STEP = 1000  # of SQLite's machine: so often it is looked at
_STEPS_PER_BYTE = 30  # a row takes some 20, and has as many bytes and more
_SURELY_FINE = 1_000_000  # steps: a hundredth of a second


def database_uri(path: Path, more: str = "") -> str:
    """The path as SQLite wants it: ?, # and % are its own, and names need not be text."""
    return quote(os.fsencode(path.resolve())) + more


def open_database(path: Path) -> sqlite3.Connection:
    """A database to be read, its tables checked.

    Raises:
        sqlite3.Error: it cannot be read.
        InputError: see `_require_tables`.
    """
    database = sqlite3.connect(f"file:{database_uri(path, '?immutable=1&mode=ro')}", uri=True)
    try:
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_CHUNK)
        database.set_progress_handler(_meter(path), _STEP)
        _require_tables(database)
    except BaseException:
        database.close()
        raise
    return database


@contextmanager
def limit_databases(path: Path) -> Iterator[None]:
    """The same for the databases that a library opens while this lasts.

    Raises:
        sqlite3.Error, InputError: see `opened`.
    """
    open_database(path).close()

    def limited(database: apsw.Connection) -> None:
        database.limit(apsw.SQLITE_LIMIT_LENGTH, MAX_CHUNK)
        database.set_progress_handler(_meter(path), _STEP)

    apsw.connection_hooks.append(limited)
    try:
        yield
    finally:
        apsw.connection_hooks.remove(limited)


def _meter(path: Path) -> Callable[[], bool]:
    """Called every so many steps; whether there were too many."""
    left = _SURELY_FINE + _STEPS_PER_BYTE * path.stat().st_size

    def spent() -> bool:
        nonlocal left
        left -= _STEP
        return left < 0

    return spent


def _require_tables(database: sqlite3.Connection) -> None:
    """Refuse views and virtual tables in place of tables, and columns that are computed.

    Raises:
        InputError: see there.
    """
    for table in _TABLES:
        query = "SELECT type, sql FROM sqlite_master WHERE name = ? COLLATE NOCASE"
        for kind, sql in database.execute(query, (table,)).fetchall():
            plain = kind == "table" and str(sql).upper().startswith("CREATE TABLE")
            columns = database.execute(f"PRAGMA table_xinfo({table})").fetchall() if plain else []
            if not plain or any(column[-1] for column in columns):
                raise InputError(f"is no bag: its {table} are no plain table")
