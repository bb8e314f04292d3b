"""Time stamps of KITTI, and which line of a file belongs to which sweep or picture."""

import re
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from stillmap.core.errors import InputError
from stillmap.core.timestamps import parse_ns
from stillmap.io.text_lines import read_lines

_DATE = re.compile(r"(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)(\.\d+)?")


def read_times(path: Path) -> list[int | None]:
    """Nanoseconds of every line: seconds, or a date with a time of day; None where unreadable.

    Dates count from 1970 in the clock they are written in.

    Raises:
        InputError: the file cannot be read.
    """
    out: list[int | None] = []
    for line in read_lines(path):
        out.append(_stamp(line.text.decode("ascii", "replace").strip()))
    texts_end = len(out)
    while texts_end and out[texts_end - 1] is None:
        texts_end -= 1
    return out[:texts_end]


def _stamp(text: str) -> int | None:
    date = _DATE.fullmatch(text)
    try:
        if date is None:
            return parse_ns(text)
        at = datetime.fromisoformat(date[1]).replace(tzinfo=UTC)
        whole = parse_ns(str(int(at.timestamp())))  # the year 9999 is beyond what it holds
        return whole + parse_ns(f"0{date[2] or '.0'}")
    except (ValueError, OverflowError):
        return None


def assign_rows(files: Sequence[Path], rows: int, where: Path) -> list[int | None]:
    """The line from 0 that belongs to each file; None: none does.

    Files whose names are numbers of lines take those, as where some sweeps are missing. Else
    there must be as many files as lines.

    Raises:
        InputError: neither.
    """
    numbers = [int(f.stem) if re.fullmatch(r"[0-9]{1,18}", f.stem) else -1 for f in files]
    fitting = all(number >= 0 for number in numbers) and len(set(numbers)) == len(numbers)
    if len(files) == rows and not (fitting and max(numbers, default=0) < rows):
        return list(range(rows))
    if not fitting or numbers[0] >= rows:
        what = f"has {rows} times for {len(files)} files, whose names do not tell which is whose"
        raise InputError(what, where=str(where))
    return [number if number < rows else None for number in numbers]
