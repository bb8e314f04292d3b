"""KITTI time stamps, and their assignment to scan and image files."""

import re
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from stillmap.core.errors import InputError
from stillmap.core.timestamps import parse_ns
from stillmap.io.text_lines import read_lines

_DATE = re.compile(r"(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)(\.\d+)?")


def read_times(path: Path) -> list[int | None]:
    """Read a stamp (ns) per line, of seconds or of a date and time; None where unreadable.

    Dates are taken as UTC.

    Raises:
        InputError: the file cannot be read.
    """
    out: list[int | None] = []
    for line in read_lines(path):
        out.append(_parse_stamp(line.text.decode("ascii", "replace").strip()))
    end = len(out)
    while end and out[end - 1] is None:
        end -= 1
    return out[:end]


def _parse_stamp(text: str) -> int | None:
    date = _DATE.fullmatch(text)
    try:
        if date is None:
            return parse_ns(text)
        at = datetime.fromisoformat(date[1]).replace(tzinfo=UTC)
        whole = parse_ns(str(int(at.timestamp())))  # refuses years beyond int64 ns
        return whole + parse_ns(f"0{date[2] or '.0'}")
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
