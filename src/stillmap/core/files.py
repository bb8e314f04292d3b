"""Atomic output of files and folders."""

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from stillmap.core.errors import InputError


def require_new(path: Path, marker: str, overwrite: bool = False) -> None:
    """Reject an output folder that is not empty.

    Args:
        path: the output folder.
        marker: glob of a file that every such folder holds; others are never overwritten.
        overwrite: whether such a folder may be replaced.

    Raises:
        InputError: `path` is a file, or a folder that is not empty and may not be replaced.
    """
    if not path.exists() and not path.is_symlink():
        return
    if not path.is_dir():
        raise InputError("is in the way: not a folder", where=str(path))
    if not any(path.iterdir()):
        return
    if not overwrite:
        raise InputError(
            "already holds something", where=str(path), hint="choose another or give overwrite=True"
        )
    if not any(path.glob(marker)):
        what = f"holds other things: only a folder with {marker} is replaced"
        raise InputError(what, where=str(path), hint="choose another")


def require_new_file(path: Path, overwrite: bool = False) -> None:
    """Reject an output file that exists already.

    Raises:
        InputError: the path exists and may not be replaced, or its folder does not exist.
    """
    if path.is_dir():
        raise InputError("is in the way: a folder", where=str(path))
    if path.exists() and not path.is_file():
        raise InputError("is in the way: no regular file", where=str(path))
    if path.exists() and not overwrite:
        raise InputError(
            "is there already", where=str(path), hint="choose another or give overwrite=True"
        )
    if not path.absolute().parent.is_dir():
        raise InputError("cannot be written: no such folder", where=str(path.parent))


@contextmanager
def atomic_folder(
    path: Path, marker: str, overwrite: bool = False, *, staging_folder: Path | None = None
) -> Iterator[Path]:
    """Context manager of a temporary folder that is renamed to `path` on success.

    Args:
        path: the output folder.
        marker, overwrite: see `require_new`.
        staging_folder: parent of the temporary folder, on the same file system; None: that of
            `path`.

    Raises:
        InputError: `path` is taken, or its parent cannot be written.
    """
    path = Path(os.path.abspath(path))
    require_new(path, marker, overwrite)
    # named before it is made: an interruption right after that finds it
    work = (staging_folder or path.parent) / f".{path.name}.{secrets.token_hex(8)}.part"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        work.mkdir(mode=0o700)
        yield work
        work.chmod(0o777 & ~_umask())
        require_new(path, marker, overwrite)  # it may have appeared meanwhile
        _move_into_place(work, path)
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror}", where=str(path)) from error
    finally:
        shutil.rmtree(work, ignore_errors=True)


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Context manager of a temporary file that is renamed to `path` on success."""
    path = Path(os.path.abspath(path))
    work, free = path.with_name(f".{path.name}.{os.getpid()}.part"), not path.exists()
    try:
        yield work
        if free and path.exists():
            raise InputError("has appeared meanwhile", where=str(path), hint="choose another")
        os.replace(work, path)
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror}", where=str(path)) from error
    finally:
        with suppress(OSError):  # read-only file systems refuse this, too
            work.unlink()


def sync(path: Path) -> None:
    """Wait until a file or folder is on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _move_into_place(work: Path, path: Path) -> None:
    if not path.exists():
        os.rename(work, path)
        return
    # rename(2) does not replace a folder that is not empty
    old = work.with_suffix(".old")
    os.rename(path, old)
    try:
        os.rename(work, path)
    except OSError:
        os.rename(old, path)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
