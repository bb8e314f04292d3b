"""From folders, patterns, URLs and manifests to single recordings, each with a name."""

import glob
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from stillmap.core.errors import InputError
from stillmap.fleet.manifest import Entry
from stillmap.fleet.storage import RECORD
from stillmap.fleet.urls import (
    has_wildcards,
    is_url,
    make_absolute,
    make_unique,
    short_name,
)
from stillmap.io.registry import FORMATS, is_recording

# no other files than recordings have them; the second only mostly
_SURE_ENDINGS = (".bag", ".db3", ".mcap", ".clf", ".clf.gz", ".pcd", ".las", ".laz", ".e57")
_USUAL_ENDINGS = (".log", ".log.gz", ".ply", ".3d", ".3d.gz")
_PLACEHOLDERS = 200  # files of a folder that are enough to recognise its format


class Source(NamedTuple):
    """A recording of the fleet.

    Attributes:
        input: absolute path, or URL.
        name: of its result; unique.
        place: name of the place that it is merged into; None: it is not merged.
    """

    input: str
    name: str
    place: str | None


def entries_of(inputs: Iterable[str], place: str | None) -> list[Entry]:
    """Inputs of the command line, all of the same place."""
    return [Entry(make_absolute(one), place, "") for one in inputs]


def find_sources(entries: Iterable[Entry], names: dict[str, str]) -> list[Source]:
    """The recordings that entries stand for, in order; each once.

    Args:
        entries: recordings, folders of recordings, and patterns.
        names: those of earlier runs by input; they stay.

    Raises:
        InputError: a folder or pattern without a recording, a bucket that cannot be read, or a
            recording that is given to two places.
    """
    places: dict[str, str | None] = {}
    for entry in entries:
        for found in _expand(entry):
            if found in places and places[found] != entry.place:
                what = f"{found} is in two places: {places[found]} and {entry.place}"
                raise InputError(what, where=entry.where)
            places[found] = entry.place
    # a result of an earlier run keeps its name even if it is not asked for now
    taken, given = {name.casefold() for name in names.values()}, set[str]()
    sources = []
    for one, place in places.items():
        name = names.get(one, "")
        if not name or name.casefold() in given:
            name = make_unique(short_name(one), taken)
        given.add(name.casefold())
        sources.append(Source(one, name, place))
    return sources


def _expand(entry: Entry) -> list[str]:
    try:
        return _expand_url(entry.input) if is_url(entry.input) else _expand_path(entry.input)
    except InputError as error:
        if not entry.where:
            raise
        raise InputError(f"{error.where}: {error.what}", where=entry.where) from error


def _expand_path(text: str) -> list[str]:
    if os.path.lexists(text) or not has_wildcards(text):
        return list(_inside(text))
    found = sorted(glob.glob(text))
    if not found:
        raise InputError("matches no file or folder", where=text)
    return _require_some(text, [one for path in found for one in _inside(path, is_pattern=True)])


def _inside(text: str, is_pattern: bool = False) -> Iterator[str]:
    """A recording itself, or those in a folder. A missing file fails later, alone."""
    path = Path(text)
    if not path.is_dir() or _is_candidate(path):
        if not is_pattern or _is_candidate(path):
            yield text
        return
    found = [str(one) for one in _list_folder(path) if _is_candidate(one)]
    yield from found if is_pattern else _require_some(text, found)


def _is_candidate(path: Path) -> bool:
    """Whether an entry of a folder is to be mapped; damaged files are, to be reported."""
    if path.is_dir():
        return is_recording(path) and not (path / RECORD).is_file()  # clouds of a result
    return path.name.lower().endswith(_SURE_ENDINGS) or is_recording(path)


def _list_folder(path: Path) -> list[Path]:
    try:
        return sorted(one for one in path.iterdir() if not one.name.startswith("."))
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=str(path)) from error


def _require_some(text: str, found: list[str]) -> list[str]:
    if not found:
        raise InputError("holds no recording", where=text, hint="`stillmap info -h` lists formats")
    return found


def _expand_url(url: str) -> list[str]:
    from stillmap.fleet import bucket

    matches = bucket.expand_pattern(url) if has_wildcards(url) else [url]
    if not matches:
        raise InputError("matches no file or folder", where=url)
    found: list[str] = []
    for match in matches:
        files = [one.name for one in bucket.list_files(match)]
        if files in ([], [""]):  # nothing, which fails later, or a file
            found += [match] if match == url or _has_name_of_file(match) else []
        else:
            found += _recordings_below(match, files)
    return _require_some(url, found)


def _recordings_below(url: str, names: list[str]) -> list[str]:
    """The recordings in a listing, recognised by names alone: its folders as empty files."""
    from stillmap.fleet.bucket import local_scratch

    with local_scratch() as scratch:
        _make_placeholders(scratch, names)
        if any(known.matches(scratch, None) for known in FORMATS):
            return [url]
        return [f"{url}/{one.name}" for one in _list_folder(scratch) if _is_named_so(one)]


def _make_placeholders(folder: Path, names: list[str]) -> None:
    count: dict[Path, int] = {}
    for name in names:
        path = folder / name
        number = count[path.parent] = count.get(path.parent, 0) + 1
        # files directly below may be recordings each
        if number <= _PLACEHOLDERS or path.parent == folder:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()


def _is_named_so(path: Path) -> bool:
    """Whether an empty file or folder has the name, or the inside, of a recording."""
    if path.is_dir():
        return any(known.matches(path, None) for known in FORMATS)
    return _has_name_of_file(path.name)


def _has_name_of_file(text: str) -> bool:
    """Whether a path or URL ends as files of recordings do."""
    return text.lower().endswith((*_SURE_ENDINGS, *_USUAL_ENDINGS))
