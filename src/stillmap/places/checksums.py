"""Checksums of what a place keeps of a session: a place grows only from what a merge wrote."""

import hashlib
import os
from collections.abc import Iterator
from pathlib import Path

from stillmap.core.errors import InputError
from stillmap.core.input_files import InputFile
from stillmap.core.json import read_json, write_json
from stillmap.places.store import BEAMS, HINT, STATE, WRITTEN_ANEW

_FILE = "checksums.json"
_ANEW = {f"{STATE}/{name}" for name in WRITTEN_ANEW}
_MAX_BYTES = 16 << 20
_DIGEST = 16  # bytes: against damage and changes by hand, not against forgery


def write_checksums(home: Path) -> None:
    """Write the checksums of a session.

    Those of files that were copied from another place are taken over with it: they were checked
    there, and would name the copy if that had failed.

    Args:
        home: `sessions/NAME` of a place, complete.
    """
    path = home / STATE / _FILE
    noted = _read_sums(path) if path.is_file() else {}
    known = {name: digest for name, digest in noted.items() if name not in _ANEW}
    sums = {name: known.get(name) or _digest(file) for name, file in _iter_files(home)}
    write_json(path, sums)


def check_checksums(home: Path) -> None:
    """Refuse a session whose files are not as they were written.

    Args:
        home: `sessions/NAME` of a place.

    Raises:
        InputError: names a file that is missing, changed or new.
    """
    path = home / STATE / _FILE
    noted = _read_sums(path)
    found = dict(_iter_files(home))
    for name in sorted({*noted, *found}, key=str):
        if name not in found:
            raise InputError("does not exist any more", where=f"{home}/{name}", hint=HINT)
        if noted.get(name) != _digest(found[name]):
            what = "was changed or damaged after it was written"
            raise InputError(what, where=found[name], hint=HINT)


def _read_sums(path: Path) -> dict[str, str]:
    try:
        return dict(read_json(path, _MAX_BYTES, HINT))
    except (ValueError, TypeError) as error:
        raise InputError("is damaged: no checksums", where=str(path), hint=HINT) from error


def _iter_files(home: Path) -> Iterator[tuple[str, str]]:
    """Names, relative to the session, and paths of the files that are checked, in order."""
    root = str(home)
    for folder, folders, names in os.walk(home / STATE):
        folders.sort()
        for name in sorted(names):
            path = f"{folder}/{name}"
            _require_file(path)
            if name != _FILE:
                yield path[len(root) + 1 :], path
    for name in BEAMS:
        path = f"{root}/beams/{name}.npy"
        if os.path.exists(path):
            _require_file(path)
            yield f"beams/{name}.npy", path


def _require_file(path: str) -> None:
    if not os.path.isfile(path):  # folders come elsewhere: a pipe, or a link to nothing
        raise InputError("is no regular file", where=path, hint=HINT)


def _digest(path: str) -> str:
    """The BLAKE2b checksum of a file.

    Raises:
        InputError: it cannot be read.
    """
    with InputFile(path) as file:
        found = hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=_DIGEST))
    return found.hexdigest()
