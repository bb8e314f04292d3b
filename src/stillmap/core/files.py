"""Outputs that appear whole or not at all.

Work lies under a hidden name beside the output, from where a rename makes it appear. A folder that
cannot be renamed, as a mount point, has the hidden name inside, and its entries are exchanged: the
file that marks what the folder is goes first and comes last.
"""

import errno
import hashlib
import os
import re
import secrets
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from fnmatch import fnmatch
from pathlib import Path

from stillmap.core.errors import InputError, explaining_refusal
from stillmap.core.interrupts import defer_signals

PREFIX = ".stillmap."  # of hidden names inside an output
# mount points, other disks, folders that must not be changed
_NO_RENAME = (errno.EBUSY, errno.EXDEV, errno.EPERM, errno.EACCES, errno.EROFS)
_MAX_STEM = 100  # bytes of a name to which something is added
_RANDOM = re.compile(r"[0-9a-f]{16}\.(part|old)")
_MAX_AGE = 86_400.0  # s without a change after which work is that of a process that was killed
_OVERWRITE = "choose another or give overwrite=True"
_OF_DISKS = "lost+found"  # in the uppermost folder of a disk


def resolve_output(path: Path) -> Path:
    """The absolute path of an output without links: what they point to is replaced, not they.

    Raises:
        InputError: links lead to each other, or no file can have such a name there.
    """
    target = Path(os.path.realpath(path))
    with explaining_refusal(path):
        if target.is_symlink():
            raise InputError("is a link that leads to itself", where=str(path))
    return target


def workplace(output: Path) -> Path:
    """The folder for temporary files of an output, on its disk where that is possible."""
    target = resolve_output(output)
    parent = target.parent
    is_writable = not parent.exists() or os.access(parent, os.W_OK | os.X_OK)
    if target.is_dir() and (_is_mount_point(target) or not is_writable):
        return target
    return parent if is_writable or not target.is_file() else Path(tempfile.gettempdir())


def _is_mount_point(folder: Path) -> bool:
    """True if something is mounted there; `ismount` misses folders bound from the same disk."""
    name = os.fsencode(folder)
    for special in b"\\\n\t ":  # as the kernel escapes them, the backslash first
        name = name.replace(bytes([special]), b"\\%03o" % special)
    with suppress(OSError):  # no Linux
        mounts = Path("/proc/self/mountinfo").read_bytes().splitlines()
        return name in (line.split(b" ")[4] for line in mounts)
    return os.path.ismount(folder)


def hidden_path(output: Path, suffix: str) -> Path:
    """A hidden name for what belongs to an output, in `workplace`; the same for equal arguments."""
    target, folder = resolve_output(output), workplace(output)
    if folder == target:
        return folder / f"{PREFIX}{suffix}"
    return folder / f".{shorten(target.name)}.{suffix}"


def shorten(name: str) -> str:
    """A name to which something can be added; the same for equal names, another for others."""
    if len(os.fsencode(name)) <= _MAX_STEM:
        return name
    digest = hashlib.sha256(os.fsencode(name)).hexdigest()[:8]
    while len(os.fsencode(name)) > _MAX_STEM - len(digest) - 1:
        name = name[:-1]
    return f"{name}-{digest}"


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
    if not _list_entries(target):
        return
    if not overwrite:
        raise InputError("already holds something", where=str(path), hint=_OVERWRITE)
    if not any(target.glob(marker)) and not any(target.glob(f"{PREFIX}*.part")):
        what = f"holds other things: only a folder with {marker} is replaced"
        raise InputError(what, where=str(path), hint="choose another")


def require_new_file(path: Path, overwrite: bool = False) -> None:
    """Reject an output file that exists already.

    Raises:
        InputError: the path exists and may not be replaced, or its folder does not exist.
    """
    target = resolve_output(path)
    if target.exists() and not target.is_file():
        raise InputError("is in the way: no regular file", where=str(path))
    if target.exists() and not overwrite:
        raise InputError("is there already", where=str(path), hint=_OVERWRITE)
    if not target.parent.is_dir():
        raise InputError("cannot be written: no such folder", where=str(path.parent))


@contextmanager
def atomic_folder(path: Path, marker: str, overwrite: bool = False) -> Iterator[Path]:
    """Context manager of a temporary folder that takes the place of `path` on success.

    Args:
        path: the output folder; a link is followed.
        marker, overwrite: see `require_new`.

    Raises:
        InputError: `path` is taken, or its parent cannot be written.
    """
    given, path = path, resolve_output(path)
    _remove_stale(path)
    require_new(given, marker, overwrite)
    with _naming_output(path, given):
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary_folder(path) as work, _naming_output(work, given):
            yield work
            require_new(given, marker, overwrite)  # it may have appeared meanwhile
            _publish_folder(work, path, marker)


@contextmanager
@defer_signals
def temporary_folder(output: Path) -> Iterator[Path]:
    """Context manager of a folder in `workplace` for work on an output, removed at the end.

    Raises:
        OSError: it cannot be made.
    """
    # named before it is made: an interruption right after that finds it
    work = hidden_path(output, f"{secrets.token_hex(8)}.part")
    try:
        work.mkdir()
        yield work
    finally:
        remove(work)


@contextmanager
@defer_signals
def atomic_file(path: Path) -> Iterator[Path]:
    """Context manager of an empty temporary file that takes the place of `path` on success.

    Raises:
        InputError: it cannot be written, or something else has this name.
    """
    given, path = path, resolve_output(path)
    require_new_file(given, overwrite=True)
    _remove_stale(path)
    is_free = not path.exists()
    work = hidden_path(path, f"{secrets.token_hex(8)}.part")
    try:
        with _naming_output(work, given):
            os.close(os.open(work, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
            yield work
            if is_free and path.exists():
                what, hint = "has appeared meanwhile", "choose another"
                raise InputError(what, where=str(given), hint=hint)
            _publish_file(work, path)
    finally:
        remove(work)


@contextmanager
def _naming_output(work: Path, output: Path) -> Iterator[None]:
    """Errors of unfinished work name the place where it will be.

    Raises:
        InputError: likewise where the system refuses to write.
    """
    try:
        with explaining_refusal(output):
            yield
    except InputError as error:
        if not error.where.startswith(str(work)):
            raise
        where = f"{output}{error.where.removeprefix(str(work))}"
        raise InputError(error.what, where=where, hint=error.hint) from error


def to_encodable(text: str) -> str:
    """A text that UTF-8 can hold: bytes of file names that are no UTF-8 become escapes."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def write_text(path: Path, text: str) -> None:
    """Write a text as UTF-8; see `to_encodable`."""
    path.write_bytes(to_encodable(text).encode("utf-8"))


def _remove_stale(output: Path) -> None:
    """Remove work of processes that were killed long ago: nothing in it has changed since."""
    head = hidden_path(output, "").name
    with suppress(OSError):
        for entry in workplace(output).iterdir():
            is_work = entry.name.startswith(head) and _RANDOM.fullmatch(entry.name[len(head) :])
            if is_work and time.time() - _last_change(entry) > _MAX_AGE:
                remove(entry)


def _last_change(work: Path) -> float:
    """Time of the last change in a file, or in a folder and all below it; s."""
    return max(entry.lstat().st_mtime for entry in (work, *work.rglob("*")))


@defer_signals
def remove(path: Path) -> None:
    """Remove a file, a link, or a folder with all in it, as far as that is possible."""
    try:
        _remove_once(path)
    except BaseException:  # Ctrl-C, where `defer_signals` is of no use
        _remove_once(path)
        raise


def _remove_once(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):  # read-only file systems refuse this, too
            path.unlink()


@defer_signals
def _publish_folder(work: Path, path: Path, marker: str) -> None:
    """Move a finished folder to its place, which may hold an earlier one."""
    old = work.with_suffix(".old")
    try:
        if path in work.parents:
            raise OSError(errno.EBUSY, os.strerror(errno.EBUSY))
        if path.exists():
            os.rename(path, old)
        os.rename(work, path)
    except OSError as error:
        if error.errno not in _NO_RENAME:
            raise
        if os.path.lexists(old):
            os.rename(old, path)
        _exchange_entries(work, path, marker)
    finally:
        if os.path.lexists(path):
            remove(old)
        elif os.path.lexists(old):
            os.rename(old, path)


@defer_signals
def _exchange_entries(work: Path, path: Path, marker: str) -> None:
    """Move the entries of a folder to the place of those of another one."""
    inside, is_new = work, not path.exists()
    if path not in work.parents:
        inside = path / f"{PREFIX}{secrets.token_hex(8)}.part"
        path.mkdir(exist_ok=True)
    try:
        if inside != work:
            shutil.copytree(work, inside, symlinks=True)
        marked = marker.partition("/")[0]
        for name in sorted(_list_entries(path), key=lambda name: not fnmatch(name, marked)):
            remove(path / name)
        for name in sorted(os.listdir(inside), key=lambda name: fnmatch(name, marked)):
            os.rename(inside / name, path / name)
    finally:
        remove(inside)
        if is_new:
            with suppress(OSError):  # something is in it
                path.rmdir()


def _list_entries(folder: Path) -> list[str]:
    """Names in a folder, without the hidden ones of unfinished work."""
    names = os.listdir(folder)
    return [name for name in names if not name.startswith(PREFIX) and name != _OF_DISKS]


@defer_signals
def _publish_file(work: Path, path: Path) -> None:
    """Move a finished file to its place; a mount point is filled."""
    try:
        os.replace(work, path)
    except OSError as error:
        if error.errno not in _NO_RENAME or not path.is_file():
            raise
        try:
            shutil.copyfile(work, path)
        except BaseException:
            os.truncate(path, 0)
            raise


def package_version() -> str:
    """The installed version of stillmap."""
    from importlib.metadata import PackageNotFoundError
    from importlib.metadata import version as installed_version

    try:
        return installed_version("stillmap")
    except PackageNotFoundError:  # run from a source tree that is not installed
        return "0+unknown"
