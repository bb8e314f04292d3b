"""The folder or bucket that a fleet writes to: its own, and of one run at a time."""

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from stillmap.core.errors import InputError
from stillmap.core.locks import open_lock
from stillmap.fleet.journal import Journal
from stillmap.fleet.outcomes import DISK_FULL, MAKE_ROOM
from stillmap.fleet.storage import STATE, FolderStorage, Storage

_LOCK = f"{STATE}/lock"


def require_fleet(storage: Storage, journal: Journal) -> None:
    """Refuse an output that holds other things than a fleet.

    Raises:
        InputError: it does, or is no folder.
    """
    if storage.is_taken() and not journal.find("started"):
        hint = "choose another; a fleet's own folder is continued"
        raise InputError("already holds something", where=storage.root, hint=hint)


@contextmanager
def lock_output(storage: Storage) -> Iterator[None]:
    """Keep other runs out of a folder while the block runs; a bucket has no locks.

    Raises:
        InputError: another run has it, or it cannot be written.
    """
    if not isinstance(storage, FolderStorage):
        yield
        return
    path = Path(storage.root) / _LOCK
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = open_lock(path)
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror}", where=storage.root) from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            hint = "wait for it, or stop it"
            raise InputError("another fleet is writing there", where=storage.root, hint=hint) from (
                error
            )
        except OSError:
            pass  # a file system without locks
        yield


@contextmanager
def explain_full_disk(storage: Storage) -> Iterator[None]:
    """Turn a full disk into one line.

    Raises:
        InputError: something could not be written.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in DISK_FULL:
            raise
        raise InputError(
            f"cannot continue: {error.strerror}", where=storage.root, hint=MAKE_ROOM
        ) from error
