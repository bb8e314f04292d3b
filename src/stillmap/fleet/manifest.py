"""Lists of recordings with a place's name for each: CSV or JSON."""

import csv
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from stillmap.core.errors import InputError, closest_match
from stillmap.core.input_files import read_text
from stillmap.fleet.urls import is_url, make_absolute

_MAX_BYTES = 64 << 20  # of a manifest: half a million recordings
_COLUMNS = ("input", "place")


class Entry(NamedTuple):
    """A recording of a manifest, or a folder or pattern of several.

    Attributes:
        input: absolute path, or URL.
        place: name of the place it is merged into; None: it is not merged.
        where: the manifest and its line.
    """

    input: str
    place: str | None
    where: str


def read_manifest(path: Path) -> list[Entry]:
    """Read a manifest; relative paths count from its folder.

    Args:
        path: a CSV file with a heading `input` or `input,place`, or a JSON file with a list of
            objects with these keys.

    Raises:
        InputError: names the line, or in JSON the number of the entry.
    """
    try:
        text = read_text(path, _MAX_BYTES)
    except UnicodeDecodeError as error:
        raise InputError("is not UTF-8", where=str(path)) from error
    rows = _read_json(path, text) if path.suffix.lower() == ".json" else _read_csv(path, text)
    entries = [_entry(path, row, where) for row, where in rows]
    if not entries:
        raise InputError("names no recording", where=str(path))
    return entries


def _read_csv(path: Path, text: str) -> Iterator[tuple[dict[str, Any], str]]:
    reader = csv.DictReader(io.StringIO(text.removeprefix("\ufeff"), newline=""), strict=True)
    try:
        _require_columns(reader.fieldnames or (), f"{path}:1")
        for row in reader:
            where = f"{path}:{reader.line_num}"
            if None in row or None in row.values():
                raise InputError("has another number of columns than the heading", where=where)
            yield row, where
    except csv.Error as error:
        where = f"{path}:{reader.reader.line_num}"
        raise InputError(f"is not CSV: {error}", where=where) from error


def _read_json(path: Path, text: str) -> Iterator[tuple[dict[str, Any], str]]:
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"is not JSON: {error}", where=str(path)) from error
    if not isinstance(found, list):
        raise InputError("is no list of objects with `input` and `place`", where=str(path))
    for number, row in enumerate(found, 1):
        where = f"{path}: entry {number}"
        if not isinstance(row, dict):
            raise InputError("is no object with `input` and `place`", where=where)
        _require_columns(row, where)
        yield row, where


def _require_columns(names: Any, where: str) -> None:
    if "input" not in names:
        raise InputError("has no column `input`", where=where, hint="the heading is: input,place")
    for name in names:
        if name not in _COLUMNS:
            near = closest_match(str(name), _COLUMNS)
            hint = f"did you mean '{near}'?" if near else "columns are input and place"
            raise InputError(f"unknown column '{name}'", where=where, hint=hint)


def _entry(path: Path, row: dict[str, Any], where: str) -> Entry:
    source, place = row["input"], row.get("place")
    if not isinstance(source, str) or not source.strip():
        raise InputError("names no recording", where=where)
    source = source.strip()
    if not is_url(source):
        source = str(path.absolute().parent / source)
    if place is None or place == "":
        return Entry(make_absolute(source), None, where)
    if not isinstance(place, str) or place != place.strip() or not is_file_name(place):
        hint = "letters, digits, and - _ . inside"
        raise InputError(f"place {place!r} is no name of a folder", where=where, hint=hint)
    return Entry(make_absolute(source), place, where)


def is_file_name(name: str) -> bool:
    """Whether a text is fit for a folder's name everywhere."""
    plain = name.replace("-", "").replace("_", "").replace(".", "").replace(" ", "")
    return bool(plain) and plain.isalnum() and name[0] not in ".-" and len(name.encode()) <= 200
