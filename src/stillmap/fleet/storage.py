"""Where the results of a fleet lie: a folder, or a bucket. Files appear whole or not at all."""

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Protocol

from stillmap.core.errors import InputError
from stillmap.core.files import resolve_output, sync
from stillmap.core.input_files import read_bytes
from stillmap.core.interrupts import defer_signals
from stillmap.fleet.scratch import remove_stale, scratch_folder

STATE = ".fleet"  # folder of the journal, of the labels of results, and of unfinished results
_MAX_BYTES = 1 << 30  # of a file of the state, read as a whole
RECORD = "run.json"  # every result has it; in a bucket it appears last, and goes first


class UnreachableError(InputError):
    """A bucket, or the way to it, fails; the same may succeed a little later."""


class Storage(Protocol):
    """A tree of files whose names are relative to a root.

    Methods raise InputError where a bucket refuses, and OSError where a file system does.
    """

    root: str

    def read(self, name: str) -> bytes | None:
        """The content of a file; None where there is none."""

    def write(self, name: str, content: bytes) -> None:
        """Write a file, whole or not at all."""

    def read_lines(self, folder: str) -> list[bytes]:
        """The lines of a journal in the order in which they were appended."""

    def append_line(self, folder: str, line: bytes) -> None:
        """Append a line, without its line feed, to a journal; it is kept when this returns."""

    def is_taken(self) -> bool:
        """Whether something lies at the root beside the folder `STATE`."""

    def attempt(self) -> AbstractContextManager[Path]:
        """A local folder for unfinished results and copies."""

    def publish(self, folder: Path, name: str) -> None:
        """Move the content of a folder of `attempt` to a name, whole or not at all."""

    def local_folder(self, name: str, attempt: Path) -> Path:
        """A result as a local folder, a copy in `attempt` where it lies elsewhere."""

    def remove_unfinished(self) -> None:
        """Remove what killed processes left."""


class FolderStorage:
    """A folder of a file system, which the workers of a cluster share."""

    def __init__(self, root: str) -> None:
        self._path = resolve_output(Path(root))
        self.root = str(self._path)

    def read(self, name: str) -> bytes | None:
        path = self._path / name
        return read_bytes(path, _MAX_BYTES) if path.is_file() else None

    def write(self, name: str, content: bytes) -> None:
        path = self._path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with self.attempt() as work, (work / path.name).open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
            os.replace(file.name, path)

    def read_lines(self, folder: str) -> list[bytes]:
        content = self.read(f"{folder}.jsonl")
        return [] if content is None else content.split(b"\n")

    def append_line(self, folder: str, line: bytes) -> None:
        path = self._path / f"{folder}.jsonl"
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a+b") as file:
            end = file.seek(0, os.SEEK_END)
            file.seek(max(0, end - 1))
            torn = file.read(1) not in (b"", b"\n")  # the write of its last line was cut off
            file.write((b"\n" if torn else b"") + line + b"\n")
            file.flush()
            os.fsync(file.fileno())

    def is_taken(self) -> bool:
        if self._path.exists() and not self._path.is_dir():
            raise InputError("is in the way: not a folder", where=self.root)
        return self._path.is_dir() and any(one.name != STATE for one in self._path.iterdir())

    @contextmanager
    def attempt(self) -> Iterator[Path]:
        # on the file system of the results: a rename publishes them
        with scratch_folder(self._work) as path:
            yield path

    @defer_signals
    def publish(self, folder: Path, name: str) -> None:
        path, old = self._path / name, folder.with_name(f"{folder.name}.old")
        _sync(folder)
        path.parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):
            os.rename(path, old)
        try:
            os.rename(folder, path)
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
            # another attempt has published the same result in between
        sync(path.parent)
        shutil.rmtree(old, ignore_errors=True)

    def local_folder(self, name: str, attempt: Path) -> Path:  # noqa: ARG002
        return self._path / name

    def remove_unfinished(self) -> None:
        remove_stale(self._work)

    @property
    def _work(self) -> Path:
        return self._path / STATE / "work"


def _sync(folder: Path) -> None:
    """Wait until every file of a folder is on the disk."""
    for path in [folder, *folder.rglob("*")]:
        sync(path)
