"""Outputs that appear complete or not at all.

Text files of bounded size: a name may lead to a device that never ends, or to a pipe.
"""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from stillmap.core.errors import InputError


def require_new(path: Path, marker: str, overwrite: bool = False) -> None:
    """Refuse an output folder that already holds something, before any work is done.

    Args:
        path: the folder to be.
        mark: name, or pattern of names, of what every such folder holds. Others are not replaced.
        overwrite: whether it may be replaced.

    Raises:
        InputError: `path` is a file, or a folder that is not empty and not to be replaced.
    """
    if not path.exists() and not path.is_symlink():
        return
    if not path.is_dir():
        raise InputError("is in the way: not a folder", where=str(path))
    if not any(path.iterdir()):
        return
    if not overwrite:
        raise InputError(
            "already holds something", where=str(path), hint="choose another or give --overwrite"
        )
    if not any(path.glob(marker)):
        what = f"holds other things: only a folder with {marker} is replaced"
        raise InputError(what, where=str(path), hint="choose another")


def require_new_file(path: Path, overwrite: bool = False) -> None:
    """Refuse an output file that is there already, before any work is done.

    Raises:
        InputError: something is there that is not to be replaced, or there is no such folder.
    """
    if path.is_dir():
        raise InputError("is in the way: a folder", where=str(path))
    if path.exists() and not path.is_file():
        raise InputError("is in the way: no regular file", where=str(path))
    if path.exists() and not overwrite:
        raise InputError(
            "is there already", where=str(path), hint="choose another or give --overwrite"
        )
    if not path.absolute().parent.is_dir():
        raise InputError("cannot be written: no such folder", where=str(path.parent))


@contextmanager
def atomic_folder(
    path: Path, marker: str, overwrite: bool = False, *, staging_folder: Path | None = None
) -> Iterator[Path]:
    """A temporary sibling folder that becomes `path` when the block ends without an exception.

    Args:
        path: the folder to be.
        mark, overwrite: see `require_new`.
        within: a folder on the same file system that the temporary one is put into instead.

    Raises:
        InputError: `path` is taken or its parent cannot be written to.
    """
    path = Path(os.path.abspath(path))
    require_new(path, marker, overwrite)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        work = Path(
            tempfile.mkdtemp(
                prefix=f".{path.name}.", suffix=".part", dir=staging_folder or path.parent
            )
        )
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror}", where=str(path)) from error
    try:
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
    """A temporary sibling file that becomes `path` when the block ends without an exception."""
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
        with suppress(OSError):  # where nothing can be written, nothing can be removed
            work.unlink()


def _move_into_place(work: Path, path: Path) -> None:
    if not path.exists():
        os.rename(work, path)
        return
    # a folder that is not empty cannot be replaced in one step: the old one steps aside first
    aside = work.with_suffix(".old")
    os.rename(path, aside)
    try:
        os.rename(work, path)
    except OSError:
        os.rename(aside, path)
        raise
    shutil.rmtree(aside, ignore_errors=True)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def read_text(path: Path, max_bytes: int) -> str:
    """The text of a file in UTF-8, of `largest` bytes at most.

    Raises:
        InputError: it cannot be read, or is larger.
        UnicodeDecodeError: it is no such text.
    """
    try:
        with path.open("rb") as file:
            content = file.read(max_bytes + 1)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=str(path)) from error
    if len(content) > max_bytes:
        raise InputError(f"is too large: more than {max_bytes >> 10} KiB", where=str(path))
    return content.decode("utf-8")


def require_regular(path: Path) -> None:
    """Refuse pipes and devices that lie where a file should: reading may wait for ever.

    A folder, or what is not there at all, is left to who opens it.

    Raises:
        InputError: there is something else than a file.
    """
    if path.exists() and not path.is_file() and not path.is_dir():
        raise InputError("is no regular file", where=str(path))
