"""Numbered lines of a text file, plain or gzip, damaged or not; files of a folder, one per scan or
image: their order, their stamps, the lines about them."""

import gzip
import re
import sys
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from decimal import Decimal
from itertools import count
from pathlib import Path
from typing import IO, NamedTuple

from stillmap.core.errors import InputError
from stillmap.core.files import atomic_file
from stillmap.core.input_files import InputFile
from stillmap.core.timestamps import MAX_STAMP_NS, parse_ns

MAX_LINE = 1 << 20  # bytes: a scan of 3600 readings with remissions has a tenth of it
_MAX_RATIO, _MIN_LIMIT = 100, 64 << 20  # size of a decompressed text: ratio (logs have 20), bytes
_LINE_COST = 32  # bytes that a line counts for in addition
_GZIP_MAGIC = b"\x1f\x8b"
_DAMAGED = (EOFError, zlib.error, gzip.BadGzipFile)

Progress = Callable[[float], None]


def share_progress(progress: Progress | None, number: int, count: int) -> Progress | None:
    """Progress within one of `count` inputs that are read one after the other."""
    if progress is None:
        return None
    return lambda share: progress((number + share) / count)


class Line(NamedTuple):
    """One line: its number from 1, and its bytes up to `MAX_LINE`.

    `damage` says why it is no line: it is too long, or stands for a broken gzip stream.
    """

    number: int
    text: bytes
    damage: str = ""


@contextmanager
def write_atomically(path: Path) -> Iterator[IO[bytes] | gzip.GzipFile]:
    """A new file, gzip by its name, which appears complete or not at all.

    Equal texts give equal bytes.
    """
    compressed = path.name.lower().endswith(".gz")
    with atomic_file(path) as work, work.open("wb") as file:
        if not compressed:
            yield file
            return
        # neither name nor time; level 6 is far faster than 9 for a tenth more bytes
        with gzip.GzipFile("", "wb", 6, fileobj=file, mtime=0) as stream:
            yield stream


def read_head(path: Path, size: int) -> bytes:
    """The first `size` bytes of a text, decompressed if gzip, fewer if damaged."""
    with InputFile(path) as file:
        compressed = file.read(2) == _GZIP_MAGIC
        file.seek(0)
        if not compressed:
            return file.read(size)
        # wbits 31: gzip container
        try:
            return zlib.decompressobj(31).decompress(file.read(size), size)
        except zlib.error:
            return b""


def read_lines(path: Path, progress: Progress | None = None) -> Iterator[Line]:
    """Read a file line by line.

    Raises:
        InputError: the file cannot be opened or read.
    """
    with InputFile(path) as file:
        size = max(file.size, 1)
        compressed = file.read(2) == _GZIP_MAGIC
        file.seek(0)
        stream = gzip.GzipFile(fileobj=file, mode="rb") if compressed else file
        number = size_read = 0
        limit = max(_MAX_RATIO * size, _MIN_LIMIT) if compressed else sys.maxsize
        try:
            while text := stream.readline(MAX_LINE):
                number += 1
                size_read += len(text) + _LINE_COST
                is_whole = text.endswith(b"\n") or len(text) < MAX_LINE
                if size_read > limit:
                    what = f"is too large: it decompresses to more than {_MAX_RATIO} times its size"
                    hint = "decompress it first"
                    raise InputError(what, where=str(path), hint=hint)
                yield Line(number, text, "" if is_whole else "a line is too long")
                if progress is not None and number % 500 == 0:
                    progress(min(file.tell() / size, 1.0))
        except _DAMAGED:
            yield Line(number + 1, b"", "its gzip stream breaks")
        except OSError as error:
            raise InputError(f"cannot be read: {error.strerror}", where=str(path)) from error


def replace_words(line: bytes, words: Mapping[int, bytes]) -> bytes:
    """A line with the words of some numbers, from 0, replaced; all else stays."""
    number = count()
    return re.sub(rb"\S+", lambda found: words.get(next(number), found[0]), line)


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
    texts = (line.text.decode("ascii", "replace").strip() for line in read_lines(path))
    out = list(map(_parse_line, texts))
    while out and out[-1] is None:
        out.pop()
    return out


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


def stamp_files(
    files: Sequence[Path], times: Sequence[int | None], where: Path
) -> list[tuple[int, Path]]:
    """Stamps and files, of those that have a line with a stamp; see `assign_rows`."""
    rows = assign_rows(files, len(times), where) if files else []
    stamps = (None if row is None else times[row] for row in rows)
    return [(stamp, file) for stamp, file in zip(stamps, files, strict=True) if stamp is not None]


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
