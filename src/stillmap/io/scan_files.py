"""Files of a folder, one per scan or image: their order, their stamps, the lines about them."""

import re
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path

from stillmap.core.errors import InputError
from stillmap.core.timestamps import MAX_STAMP_NS, parse_ns
from stillmap.io.text_lines import read_lines

_NUMBER = re.compile(r"(?:^-)?\d+(?:\.\d+)?$")

_REPEATED = re.compile(r"(-?\d{19})_\d+")  # a further scan of the same stamp, as pcd.write names it

_DATE = re.compile(r"(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)(\.\d+)?")

_NS_BY_DIGITS = {19: 1, 16: 10**3, 13: 10**6}  # digits of ns, us, ms since 1970


def list_files(folder: Path, extensions: tuple[str, ...]) -> list[Path]:
    """Visible files of a folder with one of the extensions, in natural order.

    Raises:
        InputError: the folder cannot be read.
    """
    try:
        entries = list(iter_files(folder, extensions))
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=str(folder)) from error
    return sorted(entries, key=lambda entry: (_natural_key(entry.name), entry.name))


def strip_extension(name: str, extensions: tuple[str, ...]) -> str:
    """The name without its extension."""
    for extension in extensions:
        if name.lower().endswith(extension):
            return name[: -len(extension)]
    return name


def stamps_from_names(stems: Sequence[str]) -> list[int] | None:
    """Stamps in nanoseconds where all names end with a time of one unit; else None.

    Numbers with decimals are seconds; integers of 13, 16 or 19 digits are milli-, micro- or
    nanoseconds since 1970.
    """
    times = [time for stem in stems if (time := _parse_stamp(stem)) is not None]
    if len(times) < len(stems) or len({unit for unit, _ in times}) != 1:
        return None
    return [stamp for _, stamp in times]


def _parse_stamp(stem: str) -> tuple[int, int] | None:
    """Unit (0: decimal seconds) and nanoseconds; None: no time."""
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
    scale = _NS_BY_DIGITS.get(len(match[0].lstrip("-")))
    if scale is None or abs(int(match[0]) * scale) > MAX_STAMP_NS:
        return None
    return scale, int(match[0]) * scale


def read_times(path: Path) -> list[int | None]:
    """Read a stamp (ns) per line, of seconds or of a date and time; None where unreadable.

    Dates are taken as UTC.

    Raises:
        InputError: the file cannot be read.
    """
    out: list[int | None] = []
    for line in read_lines(path):
        out.append(_parse_line(line.text.decode("ascii", "replace").strip()))
    end = len(out)
    while end and out[end - 1] is None:
        end -= 1
    return out[:end]


def _parse_line(text: str) -> int | None:
    date = _DATE.fullmatch(text)
    try:
        if date is None:
            return parse_ns(text)
        at = datetime.fromisoformat(date[1]).replace(tzinfo=UTC)
        seconds = int(at.timestamp()) + Decimal(f"0{date[2] or '.0'}")
        return parse_ns(f"{seconds:f}")  # refuses years after 2116
    except (ValueError, OverflowError):
        return None


def assign_rows(files: Sequence[Path], rows: int, where: Path) -> list[int | None]:
    """Index of the line that belongs to each file; None: there is none.

    File names that are numbers are line indices (scans may be missing); otherwise there must be as
    many files as lines.

    Raises:
        InputError: neither holds.
    """
    numbers = [int(f.stem) if re.fullmatch(r"[0-9]{1,18}", f.stem) else -1 for f in files]
    are_indices = all(number >= 0 for number in numbers) and len(set(numbers)) == len(numbers)
    if len(files) == rows and not (are_indices and max(numbers, default=0) < rows):
        return list(range(rows))
    if not are_indices or numbers[0] >= rows:
        what = f"has {rows} stamps for {len(files)} files whose names are no line numbers"
        raise InputError(what, where=str(where))
    return [number if number < rows else None for number in numbers]


def _natural_key(name: str) -> list[tuple[int, int | str]]:
    """Sort key by which `scan10` follows `scan9`."""
    parts = re.split(r"([0-9]+)", name)
    return [(1, int(part)) if i % 2 else (0, part) for i, part in enumerate(parts)]


def has_extension(path: Path, extensions: tuple[str, ...]) -> bool:
    """True if a file has one of the extensions, in any case, and is not hidden."""
    return path.name.lower().endswith(extensions) and not path.name.startswith(".")


def contains_files(folder: Path, extensions: tuple[str, ...]) -> bool:
    """True if a folder has files of these extensions; False where it cannot be read."""
    try:
        return any(iter_files(folder, extensions))
    except OSError:
        return False


def iter_files(folder: Path, extensions: tuple[str, ...]) -> Iterator[Path]:
    """Yield the files of a folder with one of the extensions, in the order of the system."""
    return (e for e in folder.iterdir() if has_extension(e, extensions) and not e.is_dir())
