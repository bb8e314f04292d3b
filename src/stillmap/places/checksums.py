"""Checksums of what a place keeps of a session: a place grows only from what a merge wrote."""

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path

from stillmap.core.errors import InputError
from stillmap.core.files import read_text, require_regular
from stillmap.places.store import BEAMS, HINT, STATE

_FILE = "checksums.json"
_MAX_BYTES = 16 << 20
_DIGEST = 16  # bytes: against damage and changes by hand, not against forgery


def write_checksums(home: Path) -> None:
    """Write the checksums of a session.

    Args:
        home: `sessions/NAME` of a place, complete.
    """
    sums = {path.relative_to(home).as_posix(): _digest(path) for path in _iter_files(home)}
    text = json.dumps(sums, indent=1, ensure_ascii=False)
    (home / STATE / _FILE).write_text(text + "\n", encoding="utf-8")


def check_checksums(home: Path) -> None:
    """Refuse a session whose files are not as they were written.

    Args:
        home: `sessions/NAME` of a place.

    Raises:
        InputError: names a file that is missing, changed or new.
    """
    path = home / STATE / _FILE
    require_regular(path)
    try:
        noted = dict(json.loads(read_text(path, _MAX_BYTES)))
    except (ValueError, TypeError, RecursionError) as error:
        raise InputError("is damaged: no checksums", where=str(path), hint=HINT) from error
    found = {one.relative_to(home).as_posix(): one for one in _iter_files(home)}
    for name in sorted({*noted, *found}, key=str):
        if name not in found:
            raise InputError("does not exist any more", where=f"{home}/{name}", hint=HINT)
        if noted.get(name) != _digest(found[name]):
            what = "was changed or damaged after it was written"
            raise InputError(what, where=str(found[name]), hint=HINT)


def _iter_files(home: Path) -> Iterator[Path]:
    """The files that are checked, in order."""
    for path in sorted((home / STATE).rglob("*")):
        require_regular(path)
        if path.is_file() and path.name != _FILE:
            yield path
    for name in BEAMS:
        path = home / "beams" / f"{name}.npy"
        require_regular(path)
        if path.is_file():
            yield path


def _digest(path: Path) -> str:
    """The BLAKE2b checksum of a file.

    Raises:
        InputError: it cannot be read.
    """
    try:
        with path.open("rb") as file:
            found = hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=_DIGEST))
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=str(path)) from error
    return found.hexdigest()
