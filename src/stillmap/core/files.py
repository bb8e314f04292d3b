"""Atomic output of files and folders."""

import os
import secrets
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from stillmap.core.errors import InputError, cannot_write
from stillmap.core.interrupts import defer_signals
from stillmap.core.output_place import (
    UNFINISHED,
    hidden_path,
    list_entries,
    require_finished,
    resolve_output,
)
from stillmap.core.publishing import (
    finish_exchange,
    hold,
    keep,
    publish_file,
    publish_folder,
    remove,
    remove_stale,
)


def require_new(path: Path, marker: str, overwrite: bool = False) -> None:
    """Reject an output folder that is not empty.

    Args:
        path: the output folder, or a link to it.
        marker: glob of a file that every such folder holds; others are never overwritten.
        overwrite: whether such a folder may be replaced.

    Raises:
        InputError: `path` is a file, or a folder that is not empty and may not be replaced.
    """
    target = resolve_output(path)
    if not target.exists():
        return
    if not target.is_dir():
        raise InputError("is in the way: not a folder", where=str(path))
    if not overwrite:
        require_finished(target)
    if not list_entries(target) or os.path.lexists(target / UNFINISHED):
        return
    if not overwrite:
        raise InputError(
            "already holds something", where=str(path), hint="choose another or give overwrite=True"
        )
    if not any(target.glob(marker)):
        what = f"holds other things: only a folder with {marker} is replaced"
        raise InputError(what, where=str(path), hint="choose another")


def require_new_file(path: Path, overwrite: bool = False) -> None:
    """Reject an output file that exists already.

    Raises:
        InputError: the path exists and may not be replaced, or its folder does not exist.
    """
    target = resolve_output(path)
    if target.is_dir():
        raise InputError("is in the way: a folder", where=str(path))
    if target.exists() and not target.is_file():
        raise InputError("is in the way: no regular file", where=str(path))
    if target.exists() and not overwrite:
        raise InputError(
            "is there already", where=str(path), hint="choose another or give overwrite=True"
        )
    if target.parent.is_dir():
        return
    if target.parent.exists():
        raise InputError("cannot be written: Not a directory", where=str(path))
    raise InputError("cannot be written: no such folder", where=str(path.parent))


@contextmanager
def atomic_folder(
    path: Path, marker: str, overwrite: bool = False, *, staging_folder: Path | None = None
) -> Iterator[Path]:
    """Context manager of a temporary folder that takes the place of `path` on success.

    A link is followed. Where `path` cannot be renamed, as a mount point, its files are exchanged
    under a journal; see `output_place.require_finished`.

    Args:
        path: the output folder.
        marker, overwrite: see `require_new`.
        staging_folder: parent of the temporary folder, on the same file system; None: see
            `output_place.workplace`.

    Raises:
        InputError: `path` is taken, or its parent cannot be written. A folder that was finished
            but cannot take its place is kept: the message says where.
    """
    given, path = path, resolve_output(path)
    remove_stale(path)
    require_new(given, marker, overwrite)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        finish_exchange(path)
        with temporary_folder(path, staging_folder) as work:
            yield work
            work.chmod(0o777 & ~_umask())
            with _kept_on_failure(work, given):
                require_new(given, marker, overwrite)  # it may have appeared meanwhile
                publish_folder(work, path, marker)
    except OSError as error:
        raise cannot_write(error, given) from error


@contextmanager
@defer_signals
def temporary_folder(output: Path, parent: Path | None = None) -> Iterator[Path]:
    """Context manager of a folder for work on an output, removed at the end.

    Args:
        output: file or folder.
        parent: where it lies; None: see `output_place.workplace`.

    Raises:
        OSError: it cannot be made.
    """
    # named before it is made: an interruption right after that finds it
    work = hidden_path(output, f"{secrets.token_hex(8)}.part")
    work = work if parent is None else parent / work.name
    with _removed_at_the_end(work, resolve_output(output)):
        work.mkdir(mode=0o700)
        with hold(work):
            yield work


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Context manager of a temporary file that takes the place of `path` on success.

    A link is followed. The temporary file is there, and empty.

    Raises:
        InputError: it cannot be written, or something else has this name.
    """
    given, path = path, resolve_output(path)
    require_new_file(given, overwrite=True)
    free = not path.exists()
    try:
        remove_stale(path)
        work = hidden_path(path, f"{secrets.token_hex(8)}.part")
        with _removed_at_the_end(work, path):
            os.close(os.open(work, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
            with hold(work):
                yield work
                if free and path.exists():
                    what, hint = "has appeared meanwhile", "choose another"
                    raise InputError(what, where=str(given), hint=hint)
                publish_file(work, path)
    except OSError as error:
        raise cannot_write(error, given) from error


@contextmanager
@defer_signals
def _removed_at_the_end(work: Path, path: Path) -> Iterator[None]:
    try:
        yield
    finally:
        # otherwise the rest of an exchange lies there
        if path not in work.parents or not os.path.lexists(path / UNFINISHED):
            remove(work)


@contextmanager
def _kept_on_failure(work: Path, path: Path) -> Iterator[None]:
    """Keep what was finished where it cannot take its place.

    Raises:
        InputError: it cannot; says where it lies.
    """
    try:
        yield
    except (OSError, InputError) as error:
        what = (error if isinstance(error, InputError) else cannot_write(error, path)).what
        if os.path.lexists(resolve_output(path) / UNFINISHED):
            hint = "its new files lie inside; overwrite=True goes on"
        else:
            kept = keep(work, path)
            hint = "" if kept is None else f"what was made is kept in {kept}"
        raise InputError(what, where=str(path), hint=hint) from error


@contextmanager
@defer_signals
def new_folder(prefix: str, parent: Path | None = None) -> Iterator[Path]:
    """Context manager of a new folder, of which nothing is left if the block fails.

    Args:
        prefix: start of its name.
        parent: where it lies; None: among temporary files.

    Raises:
        OSError: it cannot be made.
    """
    parent = Path(tempfile.gettempdir()) if parent is None else parent
    folder = parent / f"{prefix}{secrets.token_hex(8)}"
    try:
        folder.mkdir(mode=0o700)
        yield folder
    except BaseException:
        remove(folder)
        raise


def sync(path: Path) -> None:
    """Wait until a file or folder is on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def nearest_folder_above(path: str | os.PathLike[str]) -> Path:
    """The first folder above a path that is there."""
    return next(one for one in Path(path).absolute().parents if one.is_dir())


def to_encodable(text: str) -> str:
    """A text that UTF-8 can hold: bytes of file names that are no UTF-8 become escapes."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def write_text(path: Path, text: str) -> None:
    """Write a text as UTF-8; see `to_encodable`."""
    path.write_bytes(to_encodable(text).encode("utf-8"))
