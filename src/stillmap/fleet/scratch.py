"""Temporary folders that are found and removed even if their process was killed."""

import fcntl
import os
import secrets
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from stillmap.core.errors import InputError
from stillmap.core.interrupts import defer_signals
from stillmap.core.locks import open_lock

_LOCK = ".lock"


@contextmanager
@defer_signals
def scratch_folder(parent: Path) -> Iterator[Path]:
    """A new folder below `parent`, locked while the block runs and removed after it.

    Raises:
        OSError: it cannot be made.
    """
    path, file = _make_locked(parent)
    try:
        path.mkdir()
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)
        _lock_of(path).unlink(missing_ok=True)
        file.close()
        _remove_empty(parent)


def make_folder(path: Path, mode: int = 0o777) -> os.stat_result:
    """Make a folder unless it is there, and look at it; others may remove it meanwhile.

    Raises:
        OSError: it cannot be made, or something else has its name.
    """
    while True:
        taken = None
        try:
            path.mkdir(mode, parents=True)
        except FileExistsError as error:
            taken = error
        with suppress(FileNotFoundError):
            found = path.lstat()
            if taken is not None and not stat.S_ISDIR(found.st_mode) and not path.is_dir():
                raise taken
            return found


def remove_stale(parent: Path) -> None:
    """Remove the scratch folders below `parent` whose processes are gone, then `parent` if empty.

    A folder whose lock is held elsewhere stays.
    """
    locks = list[Path]()
    with suppress(FileNotFoundError, NotADirectoryError):
        locks = [path for path in sorted(parent.iterdir()) if path.name.endswith(_LOCK)]
    for lock in locks:
        with suppress(OSError, InputError), open_lock(lock) as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(lock.with_suffix(""), ignore_errors=True)
            lock.unlink(missing_ok=True)
    _remove_empty(parent)


def _remove_empty(folder: Path) -> None:
    with suppress(OSError):  # it is not empty
        folder.rmdir()


def _lock_of(path: Path) -> Path:
    return path.with_name(f"{path.name}{_LOCK}")


def _make_locked(parent: Path) -> tuple[Path, IO[bytes]]:
    """The name of a folder, and its open lock, which the kernel frees when this process ends."""
    while True:
        make_folder(parent)
        path = parent / secrets.token_hex(8)
        try:
            file = _lock_of(path).open("xb")
        except FileNotFoundError:  # another process has just removed the parent
            continue
        with suppress(OSError):  # a file system without locks
            fcntl.flock(file, fcntl.LOCK_EX)
        if _lock_of(path).exists():  # else `remove_stale` came between the two lines above
            return path, file
        file.close()
