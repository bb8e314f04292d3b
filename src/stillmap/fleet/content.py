"""Identity of a recording: a quick fingerprint, and the hash of its content."""

import hashlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from stillmap.core.errors import InputError
from stillmap.core.input_files import InputFile
from stillmap.fleet.urls import is_url

_BLOCK = 1 << 20  # bytes


class Content(NamedTuple):
    """The content of a recording.

    Attributes:
        digest: SHA-256 over the names and the bytes of its files.
        size: bytes.
    """

    digest: str
    size: int


def fingerprint(source: str) -> str:
    """A hash that differs where the content may differ, without reading it.

    Over the names, sizes and times of the files at a path; over names, sizes and ETags at a URL.

    Raises:
        InputError: there is nothing, or it cannot be listed.
    """
    if is_url(source):
        from stillmap.fleet.bucket import list_files

        found = [tuple(one) for one in list_files(source)]
    else:
        found = [
            (name, about.st_size, about.st_mtime_ns)
            for name, path in _files(Path(source))
            for about in (path.stat(),)
        ]
    if not found:
        raise InputError("does not exist", where=source)
    return hashlib.sha256(repr(found).encode()).hexdigest()


def hash_content(path: Path) -> Content:
    """Read every file of a recording and hash it.

    Raises:
        OSError: a file cannot be read.
    """
    whole, size = hashlib.sha256(), 0
    for name, file_path in _files(path):
        one = hashlib.sha256()
        with InputFile(file_path) as file:
            while block := file.read(_BLOCK):
                one.update(block)
                size += len(block)
        whole.update(repr((name, one.hexdigest())).encode())
    return Content(whole.hexdigest(), size)


def _files(path: Path) -> Iterator[tuple[str, Path]]:
    """The regular files at and below a path with their relative names, by name."""
    if path.is_file():
        yield "", path
        return
    for folder, folders, names in os.walk(path):
        folders.sort()
        for name in sorted(names):
            one = Path(folder) / name
            if one.is_file():
                yield one.relative_to(path).as_posix(), one
