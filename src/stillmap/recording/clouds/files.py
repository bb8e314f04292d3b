"""Files of a folder, in order, and the times that their names may tell."""

import re
from collections.abc import Sequence
from pathlib import Path

from stillmap.errors import InputError
from stillmap.recording.stamps import parse_ns

_NUMBER = re.compile(r"(?:^-)?\d+(?:\.\d+)?$")
_REPEATED = re.compile(r"(-?\d{19})_\d+")  # a second scan of one stamp, as we write it
_DIGITS_OF_NS = {19: 1, 16: 10**3, 13: 10**6}  # of ns, us, ms since 1970, or filled with zeros


def files_in(folder: Path, endings: tuple[str, ...]) -> list[Path]:
    """Files of a folder with such names in the order of the numbers in them; no hidden ones.

    Raises:
        InputError: the folder cannot be read.
    """
    try:
        entries = [e for e in folder.iterdir() if is_named(e, endings) and not e.is_dir()]
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=str(folder)) from error
    return sorted(entries, key=lambda entry: (_natural(entry.name), entry.name))


def is_named(path: Path, endings: tuple[str, ...]) -> bool:
    """Whether a file's name ends so, in small letters or large, and it is not hidden."""
    return path.name.lower().endswith(endings) and not path.name.startswith(".")


def holds_any(folder: Path, endings: tuple[str, ...]) -> bool:
    """Whether a folder has such files; False where it cannot be read."""
    try:
        return any(is_named(entry, endings) and not entry.is_dir() for entry in folder.iterdir())
    except OSError:
        return False


def require_content(path: Path) -> None:
    """Refuse what is no file or holds nothing.

    Raises:
        InputError: see there.
    """
    try:
        if not path.is_file():
            what = "is no regular file" if path.exists() else "leads nowhere"
            raise InputError(what, where=str(path))
        if path.stat().st_size == 0:
            raise InputError("is empty", where=str(path))
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=str(path)) from error


def stem_of(name: str, endings: tuple[str, ...]) -> str:
    """The name without its ending."""
    for ending in endings:
        if name.lower().endswith(ending):
            return name[: -len(ending)]
    return name


def stamps_in(stems: Sequence[str]) -> list[int] | None:
    """Nanoseconds, where all names end with a time of one kind; else None.

    Seconds have decimals; whole numbers have the digits of milli-, micro- or nanoseconds since
    1970, maybe with zeros before.
    """
    found = [_stamp(stem) for stem in stems]
    if not found or any(one is None for one in found):
        return None
    if len({kind for kind, _ in (one for one in found if one is not None)}) > 1:
        return None
    return [stamp for _, stamp in (one for one in found if one is not None)]


def _stamp(stem: str) -> tuple[int, int] | None:
    """Kind and nanoseconds."""
    repeated = _REPEATED.fullmatch(stem)
    text = repeated[1] if repeated else stem
    match = _NUMBER.search(text)
    if match is None:
        return None
    if "." in match[0]:
        try:
            return 0, parse_ns(match[0])
        except ValueError:
            return None
    scale = _DIGITS_OF_NS.get(len(match[0].lstrip("-")))
    if scale is None or not -(2**63) < int(match[0]) * scale < 2**63:
        return None
    return scale, int(match[0]) * scale


def _natural(name: str) -> list[tuple[int, int | str]]:
    """`scan10` comes after `scan9`."""
    parts = re.split(r"([0-9]+)", name)
    return [(1, int(part)) if i % 2 else (0, part) for i, part in enumerate(parts)]
