"""Opening of files that are read: regular ones alone, and no more of them than there was at first.

Pipes, devices and loops of links are refused before they are opened, for reading them may block or
never end. Files may change meanwhile: what is appended is not read, and a file that becomes shorter
is an error. That is why none is memory-mapped: a page of which the file has lost the bytes cannot
be read any more, and the attempt ends the process.
"""

import fcntl
import io
import os
import shutil
import stat
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

from stillmap.core.errors import InputError

_BUFFER = 1 << 16  # bytes read at once


class ShorterFileError(InputError):
    """A file has become shorter while it was read."""


class InputFile(io.BufferedReader):
    """A regular file that is read, up to the size that it had when it was opened.

    Attributes:
        size: bytes.

    Raises:
        InputError: it is missing, no regular file, or cannot be opened.
        ShorterFileError: in all methods that read.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        try:
            raw = _RegularFile(path)
        except OSError as error:
            what = f"cannot be read: {error.strerror or error}"
            raise InputError(what, where=str(path)) from error
        except ValueError as error:  # a NUL in it, or no text
            where = ascii(os.fspath(path))
            raise InputError(f"is no usable path: {error}", where=where) from error
        self.size = raw.size
        super().__init__(raw, _BUFFER)


class _RegularFile(io.FileIO):
    def __init__(self, path: str | os.PathLike[str]) -> None:
        super().__init__(path, "r", opener=_open_regular)
        self._path, self.size = path, os.fstat(self.fileno()).st_size

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer).cast("B")
        view = view[: max(self.size - self.tell(), 0)]
        n = super().readinto(view)
        if len(view) and not n:
            what = f"has become shorter while it was read: it ends at byte {self.tell()}"
            raise ShorterFileError(what, where=os.fspath(self._path))
        return n or 0

    def readall(self) -> bytes:
        out = bytearray(max(self.size - self.tell(), 0))
        view, at = memoryview(out), 0
        while at < len(out):
            at += self.readinto(view[at:])
        return bytes(out)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        if whence == os.SEEK_END:
            offset, whence = self.size + offset, os.SEEK_SET
        return super().seek(offset, whence)


def _open_regular(path: str, flags: int) -> int:
    """A descriptor of a regular file, of which others are not even opened."""
    require_regular(path)
    # non-blocking: a pipe may have come meanwhile
    handle = os.open(path, flags | os.O_NONBLOCK | os.O_NOCTTY)
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise _irregular_error(path)
    return handle


def require_regular(path: str | os.PathLike[str]) -> None:
    """Refuse what is no regular file, for libraries that open files by themselves.

    Raises:
        InputError: it is a folder, pipe, socket or device.
        OSError: it is missing, or cannot be reached.
    """
    mode = os.stat(path).st_mode
    if stat.S_ISDIR(mode):
        raise InputError("cannot be read: it is a folder", where=os.fspath(path))
    if not stat.S_ISREG(mode):
        raise _irregular_error(path)


def _irregular_error(path: str | os.PathLike[str]) -> InputError:
    return InputError("is no regular file", where=os.fspath(path))


class InputPath(type(Path())):  # type: ignore[misc]
    """A path for libraries that open files by `Path.open`; see `InputFile`."""

    def open(self, mode: str = "r", *_: Any, **__: Any) -> InputFile:
        if mode != "rb":
            raise ValueError(f"mode: expected rb, got {mode}")
        return InputFile(self)


def read_bytes(path: Path, max_bytes: int) -> bytes:
    """The content of a file of at most `max_bytes` bytes.

    Raises:
        InputError: it cannot be read, or is larger.
    """
    with InputFile(path) as file:
        if file.size > max_bytes:
            limit = f"{max_bytes >> 20} MiB" if max_bytes >> 20 else f"{max_bytes >> 10} KiB"
            raise InputError(f"is too large: more than {limit}", where=str(path))
        return file.read()


def read_text(path: Path, max_bytes: int) -> str:
    """The content of a UTF-8 file of at most `max_bytes` bytes.

    Raises:
        InputError: it cannot be read, is larger, or no text.
    """
    try:
        return read_bytes(path, max_bytes).decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError("is not a text file", where=str(path)) from error


def copy_content(source: str | os.PathLike[str], target: str | os.PathLike[str]) -> None:
    """Copy a file, with permissions as of new files.

    Raises:
        InputError: the source cannot be read.
        OSError: the target cannot be written.
    """
    with InputFile(source) as file, open(target, "wb") as copy:
        shutil.copyfileobj(file, copy)


def copy_file(source: str | os.PathLike[str], target: str | os.PathLike[str]) -> None:
    """Copy a file with its permissions and dates; see `copy_content`."""
    copy_content(source, target)
    shutil.copystat(source, target)


def hold_lock(path: Path, what: str, where: str) -> IO[bytes]:
    """Lock a file, which is made with its folder; the kernel unlocks it when this process ends.

    Args:
        path: of the lock file, which its holder may remove.
        what: of the error where another process holds the lock.
        where: the output that it guards, of that error.

    Raises:
        InputError: another process holds the lock, or the file is no regular one.
        OSError: the file cannot be made, or it is a link.
    """
    while True:
        path.parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):  # the process that had it has just ended
            if path.exists():
                require_regular(path)  # to open a pipe would wait for its reader
            # a link that leads nowhere would be made again and again
            flags = os.O_WRONLY | os.O_CREAT | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC
            file = os.fdopen(os.open(path, flags, 0o666), "wb")
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                file.close()
                raise InputError(what, where=where, hint="wait for it, or stop it") from error
            except OSError:
                pass  # a file system without locks
            if os.path.samestat(os.stat(path), os.fstat(file.fileno())):
                return file
            file.close()
