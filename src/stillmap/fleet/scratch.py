"""Temporary folders that are found and removed even if their process was killed."""

import fcntl
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

_LOCK = ".lock"


@contextmanager
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


def remove_stale(parent: Path) -> None:
    """Remove the scratch folders below `parent` whose processes are gone, then `parent` if empty.

    A folder whose lock is held elsewhere stays.
    """
    if not parent.is_dir():
        return
    for lock in sorted(parent.glob(f"*{_LOCK}")):
        with suppress(OSError), lock.open("ab") as file:
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
        parent.mkdir(parents=True, exist_ok=True)
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
