"""Unfinished work becomes an output: by a rename, or entry by entry under a journal."""

import errno
import fcntl
import json
import os
import secrets
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from fnmatch import fnmatch
from pathlib import Path

from stillmap.core.errors import InputError
from stillmap.core.input_files import read_bytes
from stillmap.core.interrupts import defer_signals
from stillmap.core.output_place import (
    PREFIX,
    UNFINISHED,
    hidden_path,
    is_fixed,
    is_temporary,
    list_entries,
    workplace,
)

# mount points, other disks, folders that must not be changed
_NO_RENAME = (errno.EBUSY, errno.EXDEV, errno.EPERM, errno.EACCES, errno.EROFS)
_MAX_JOURNAL = 64 << 20  # bytes
_MIN_AGE = 10.0  # s, at most, between the steps of a process that is alive
_HEAD = 4096  # bytes of a file that is written in place that appear last


@contextmanager
def hold(work: Path) -> Iterator[None]:
    """Lock unfinished work while the block runs: `remove_stale` leaves it alone."""
    handle = os.open(work, os.O_RDONLY)
    try:
        with suppress(OSError):  # a file system without locks
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(handle)


def remove_stale(output: Path) -> None:
    """Remove unfinished work of processes that were killed while they wrote this output.

    What they had moved aside comes back.
    """
    with suppress(OSError):
        for entry in workplace(output).iterdir():
            if is_temporary(entry.name, output) and not entry.is_symlink():
                with suppress(OSError):
                    _remove_unless_held(entry, output)


def _remove_unless_held(entry: Path, output: Path) -> None:
    if time.time() - entry.lstat().st_ctime < _MIN_AGE:
        return
    handle = os.open(entry, os.O_RDONLY | os.O_NONBLOCK)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if entry.suffix == ".old" and not output.exists():
            os.rename(entry, output)
        else:
            remove(entry)
    finally:
        os.close(handle)


@defer_signals
def remove(path: Path) -> None:
    """Remove a file, a link, or a folder with all in it, as far as that is possible."""
    try:
        _remove(path)
    except BaseException:  # Ctrl-C, where `defer_signals` is of no use
        _remove(path)
        raise


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):  # read-only file systems refuse this, too
            path.unlink()


def publish_folder(work: Path, path: Path, marker: str) -> None:
    """Move a finished folder to its place, which may hold an earlier one.

    Args:
        work: the folder.
        path: its place, without links.
        marker: glob of the files that tell what the folder is: they come last.

    Raises:
        OSError: it cannot be moved; an earlier folder is still there, or the journal says how far
            the exchange has come.
    """
    if not is_fixed(path):
        try:
            _replace_folder(work, path)
            return
        except OSError as error:
            if error.errno not in _NO_RENAME:
                raise
    if path in work.parents:
        _exchange_files(work, path, marker)
    else:
        inside = path / f"{PREFIX}{secrets.token_hex(8)}.part"
        with _removed_on_failure(inside, path):
            path.mkdir(exist_ok=True)
            shutil.copytree(work, inside, symlinks=True)
            _exchange_files(inside, path, marker)


@contextmanager
@defer_signals
def _removed_on_failure(inside: Path, path: Path) -> Iterator[None]:
    """Remove a copy inside a folder if the block fails, and the folder if it was not there."""
    is_new = not path.exists()
    try:
        yield
    except BaseException:
        if not os.path.lexists(path / UNFINISHED):  # otherwise the exchange goes on from there
            remove(inside)
        if is_new:
            with suppress(OSError):  # something is in it
                path.rmdir()
        raise


@defer_signals
def _replace_folder(work: Path, path: Path) -> None:
    if not path.exists():
        os.rename(work, path)
        return
    # rename(2) does not replace a folder that is not empty
    old = work.with_suffix(".old")
    try:
        os.rename(path, old)
        os.rename(work, path)
    finally:
        if not os.path.lexists(work):
            remove(old)
        elif os.path.lexists(old):
            os.rename(old, path)


@defer_signals
def _exchange_files(work: Path, path: Path, marker: str) -> None:
    """Move a finished folder inside another one to the place of what that one holds."""
    _note_exchange(work, path, marker)
    finish_exchange(path)


def _note_exchange(work: Path, path: Path, marker: str) -> None:
    """Write the journal: from now on the folder is not whole until the exchange has ended."""

    def is_marker(name: str) -> bool:
        return fnmatch(name, marker.partition("/")[0])

    journal = {
        "work": str(work.relative_to(path)),
        "old": sorted(list_entries(path), key=lambda name: (not is_marker(name), name)),
        "new": sorted(os.listdir(work), key=lambda name: (is_marker(name), name)),
    }
    draft = path / f"{UNFINISHED}.part"
    try:
        with draft.open("w", encoding="ascii") as file:
            json.dump(journal, file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(draft, path / UNFINISHED)
    except BaseException:
        remove(draft)
        raise


@defer_signals
def finish_exchange(path: Path) -> None:
    """Go on with the exchange of files that the journal of a folder names, if there is one.

    Raises:
        OSError: a file cannot be moved.
        InputError: the journal is damaged.
    """
    found = _read_journal(path)
    if found is None:
        return
    work, old, new = found
    for name in old:
        if name not in new or os.path.lexists(work / name):  # otherwise it is the new one
            remove(path / name)
    for name in new:
        if os.path.lexists(work / name):
            os.rename(work / name, path / name)
    remove(work)
    (path / UNFINISHED).unlink()


def _read_journal(path: Path) -> tuple[Path, list[str], list[str]] | None:
    if not os.path.lexists(path / UNFINISHED):
        return None
    try:
        journal = json.loads(read_bytes(path / UNFINISHED, _MAX_JOURNAL))
        work, old, new = Path(journal["work"]), list(journal["old"]), list(journal["new"])
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError("is damaged", where=str(path / UNFINISHED)) from error
    names = [*work.parts, *old, *new]
    is_plain = all(isinstance(one, str) and one == os.path.basename(one) for one in names)
    if not is_plain or {"", "..", "."} & set(names) or not work.parts[0].startswith(PREFIX):
        raise InputError("is damaged", where=str(path / UNFINISHED))
    return path / work, old, new


def publish_file(work: Path, path: Path) -> None:
    """Move a finished file to its place; where it cannot be renamed, write it there.

    Raises:
        OSError: it cannot be moved; what was written in place is emptied.
    """
    try:
        os.replace(work, path)
    except OSError as error:
        if error.errno not in _NO_RENAME or not path.is_file():
            raise
        _write_in_place(work, path)


def _write_in_place(work: Path, path: Path) -> None:
    """Copy a file over another one, its head last: half of it is never taken for the whole."""
    with work.open("rb") as source, path.open("r+b") as target:
        try:
            target.truncate(0)
            head = source.read(_HEAD)
            target.write(bytes(len(head)))
            shutil.copyfileobj(source, target, 1 << 20)
            target.flush()
            os.fsync(target.fileno())
            target.seek(0)
            target.write(head)
            target.flush()
        except BaseException:
            target.truncate(0)
            raise


def keep(work: Path, path: Path) -> Path | None:
    """Give finished work that cannot be moved to its place a name beside it that stays.

    Returns:
        Where it lies now; None where it has gone.
    """
    name = hidden_path(path, f"{secrets.token_hex(4)}.kept")
    kept = name.with_name(name.name.lstrip("."))
    try:
        os.rename(work, kept)
    except OSError:
        return work if os.path.lexists(work) else None
    return kept
