"""Paths and URLs through fsspec; from folders, patterns and manifests to single recordings."""

import csv
import hashlib
import io
import itertools
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, NamedTuple

import msgspec
from msgspec import Meta

from stillmap.core.errors import InputError, MissingExtra, import_extra
from stillmap.core.input_files import read_text
from stillmap.io.registry import FORMATS, is_recording

_MAX_MANIFEST = 64 << 20  # bytes
# no other files than recordings have them; the second only mostly
_SURE_ENDINGS = (".bag", ".db3", ".mcap", ".clf", ".clf.gz", ".pcd", ".las", ".laz", ".e57")
_USUAL_ENDINGS = (".log", ".log.gz", ".ply", ".3d", ".3d.gz")
# endings that are left out of a name, one after the other
_ENDINGS = re.compile(
    r"(\.(log|clf|txt|gz|bag|db3|mcap|pcd|ply|las|laz|e57|3d|zstd|zst))+$", re.IGNORECASE
)


def open_location(text: str) -> tuple[Any, str]:
    """The fsspec file system of a path or URL, and the path in it; nothing is created.

    Listings are never remembered: others may write meanwhile.

    Raises:
        InputError: a URL of a kind that fsspec does not know.
        MissingExtra: the library for it is not installed.
    """
    fsspec = import_extra("fsspec", text, group="fleet")
    if "://" not in text:
        return fsspec.filesystem("file"), os.path.abspath(text)
    if "::" in text:
        raise InputError("chained URLs are not supported", where=text)
    try:
        fs, path = fsspec.url_to_fs(text, use_listings_cache=False)
    except ImportError as error:
        raise MissingExtra(f"cannot be opened: {error}", where=text) from error
    except ValueError as error:
        raise InputError(f"is no path or URL: {error}", where=text) from error
    return fs, path.rstrip("/")


def is_local(text: str) -> bool:
    """True if a path or URL is in the file system of this machine."""
    return "://" not in text or text.startswith("file://")


def absolute(text: str) -> str:
    """A path or URL that means the same in every working directory."""
    fs, path = open_location(text)
    return path if is_local(text) else str(fs.unstrip_protocol(path))


@contextmanager
def explain(url: str, action: str) -> Iterator[None]:
    """Turn whatever fsspec, its libraries or the network raise into one line.

    Raises:
        InputError: the block failed.
    """
    try:
        yield
    except InputError:
        raise
    except FileNotFoundError as error:
        raise InputError("does not exist", where=url) from error
    except Exception as error:
        what = re.sub(r"\s+", " ", str(error)) or type(error).__name__
        what = re.sub(r"\?[^\s\"]*", "", what)  # queries of URLs may hold keys
        raise InputError(f"cannot be {action}: {what}", where=url) from error


def list_files(url: str) -> dict[str, dict[str, Any]]:
    """The fsspec records of the files at and below a path or URL, by their names relative to it.

    Raises:
        InputError: there is nothing, it cannot be read, or a name would lead out of the folder.
    """
    fs, root = open_location(url)
    with explain(url, "read"):
        entries = fs.find(root, detail=True)
    files = {
        path.removeprefix(root).removeprefix("/"): about
        for path, about in sorted(entries.items())
        if about["type"] == "file" or (is_local(url) and os.path.isfile(path))
    }
    if not files:
        raise InputError("does not exist", where=url)
    for name in files:
        if name and not all(map(is_component, name.split("/"))):
            raise InputError(f"holds a file with an unsafe name: {name!r}", where=url)
    return files


def fetch(url: str, folder: Path) -> Path:
    """Copy the file or the tree at a URL into a local folder, under its own name.

    Raises:
        InputError: see `list_files`.
    """
    fs, root = open_location(url)
    name = root.rpartition("/")[2]
    if not is_component(name):
        raise InputError("has an unsafe name", where=url)
    for relative in list_files(url):
        target = folder / name / relative if relative else folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        with explain(url, "read"):
            fs.get_file(f"{root}/{relative}" if relative else root, str(target))
    return folder / name


def hash_content(url: str) -> str:
    """A digest of the names and contents of the files of a recording.

    At a URL the ETags, or what else the storage knows of a version, stand for the contents.

    Raises:
        InputError: it cannot be read.
    """
    fs, whole = open_location(url)[0], hashlib.sha256()
    for name, about in list_files(url).items():
        with explain(url, "read"):
            if is_local(url):
                with fs.open(about["name"]) as file:
                    version = hashlib.file_digest(file, "sha256").hexdigest()
            else:
                version = about.get("ETag") or fs.ukey(about["name"])
        whole.update(repr((name, version)).encode())
    return whole.hexdigest()


def is_component(name: str) -> bool:
    """True if a name from outside is a single path component, neither `.` nor `..`."""
    return name not in ("", ".", "..") and not any(c in "/\\\0" for c in name)


def is_folder_name(name: str) -> bool:
    """True if every file system accepts a text as the name of a folder."""
    plain = re.sub(r"[-_. ]", "", name)
    return plain.isalnum() and name[0] not in ".-" and len(name.encode()) <= 200


class Entry(NamedTuple):
    """A recording, or a folder or pattern of several.

    Attributes:
        input: absolute path, or URL.
        place: name of the place it is merged into; None: it is not merged.
        where: the manifest and the number of the entry; empty: from the command line.
    """

    input: str
    place: str | None
    where: str = ""


class _Row(msgspec.Struct, forbid_unknown_fields=True):
    input: Annotated[str, Meta(pattern=r"\S")]
    place: str | None = None


class Source(NamedTuple):
    """A recording of the fleet: its absolute path or URL, the unique name of its result, and the
    place that it is merged into, if any."""

    input: str
    name: str
    place: str | None


def read_manifest(location: str) -> list[Entry]:
    """Read a list of recordings, each with its place; relative paths count from its folder.

    Args:
        location: path or URL of a CSV file with a heading `input` or `input,place`, or of a JSON
            file with a list of objects with these keys.

    Raises:
        InputError: names the number of the entry.
    """
    fs, path = open_location(location)
    with explain(location, "read"):
        if is_local(location):
            text = read_text(Path(path), _MAX_MANIFEST)
        else:
            text = fs.cat_file(path, end=_MAX_MANIFEST).decode()
    try:
        if location.lower().endswith(".json"):
            rows = msgspec.json.decode(text, type=list[Any])
        else:
            lines = io.StringIO(text.removeprefix("\ufeff"), newline="")
            rows = list(csv.DictReader(lines, strict=True))
    except (csv.Error, msgspec.DecodeError, RecursionError) as error:
        raise InputError(f"is no list of recordings: {error}", where=location) from error
    if not rows:
        raise InputError("names no recording", where=location)
    folder = absolute(location).rpartition("/")[0]
    return [_entry(folder, row, f"{location}: entry {k}") for k, row in enumerate(rows, 1)]


def _entry(folder: str, content: Any, where: str) -> Entry:
    try:
        row = msgspec.convert(content, _Row)
    except msgspec.ValidationError as error:
        hint = "the columns are `input` and `place`"
        raise InputError(str(error), where=where, hint=hint) from error
    if row.place and not is_folder_name(row.place):
        hint = "letters, digits, and - _ . inside"
        raise InputError(f"place {row.place!r} is no name of a folder", where=where, hint=hint)
    source = row.input.strip()
    if "://" not in source and not source.startswith("/"):
        source = f"{folder}/{source}"
    return Entry(absolute(source), row.place or None, where)


def find_sources(entries: Iterable[Entry]) -> dict[str, str | None]:
    """The recordings that entries stand for, in order, each with its place.

    Args:
        entries: recordings, folders of recordings, and patterns.

    Raises:
        InputError: a folder or pattern without a recording, storage that cannot be read, or a
            recording that is given to two places.
    """
    places: dict[str, str | None] = {}
    for entry in entries:
        for source in _expand(entry.input):
            if places.setdefault(source, entry.place) != entry.place:
                what = f"{source} is in two places: {places[source]} and {entry.place}"
                raise InputError(what, where=entry.where)
    return places


def name_sources(places: Mapping[str, str | None], names: Mapping[str, str]) -> list[Source]:
    """Recordings with a name for the result of each.

    Args:
        places: of the recordings.
        names: those of earlier runs by input; they stay, even of recordings not given now.
    """
    taken = {name.casefold() for name in names.values()}
    return [
        Source(source, names.get(source) or make_unique(short_name(source), taken), place)
        for source, place in places.items()
    ]


def short_name(location: str) -> str:
    """The last part of a path or URL without the endings of recordings, fit for a folder's name."""
    last = location.rstrip("/").rpartition("/")[2]
    stem = re.sub(r"[^\w.-]", "_", _ENDINGS.sub("", last) or last).lstrip(".-")[:100]
    return stem or "recording"


def make_unique(name: str, taken: set[str]) -> str:
    """`name`, or `name-2`, `name-3`, ... where it is taken; case does not matter."""
    numbered = (f"{name}-{number}" for number in itertools.count(2))
    candidates = itertools.chain([name], numbered)
    unique = next(each for each in candidates if each.casefold() not in taken)
    taken.add(unique.casefold())
    return unique


def _expand(location: str) -> list[str]:
    fs, path = open_location(location)
    with explain(location, "read"):
        is_pattern = re.search(r"[*?[]", location) is not None and not fs.exists(path)
        matches = sorted(fs.glob(path)) if is_pattern else [path]
        if not matches:
            raise InputError("matches no file or folder", where=location)
        sources = [source for match in matches for source in _inside(fs, match, is_pattern)]
    if not sources:
        hint = "`stillmap info -h` lists formats"
        raise InputError("holds no recording", where=location, hint=hint)
    return sources


def _inside(fs: Any, path: str, is_pattern: bool) -> list[str]:
    """A recording itself, or those in a folder. A missing file fails later, alone."""
    local = "file" in fs.protocol
    url = path if local else str(fs.unstrip_protocol(path))
    if not fs.isdir(path):
        return [url] if not is_pattern or _is_candidate(Path(path), local) else []
    with TemporaryDirectory(prefix="stillmap-") as scratch:
        folder = Path(path if local else scratch)
        for name in () if local else list_files(url):  # formats of folders are known by their names
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).touch()
        if _is_candidate(folder, local):
            return [url]
        inside = sorted(name for name in os.listdir(folder) if is_component(name))
        return [
            f"{url}/{name}"
            for name in inside
            if not name.startswith(".") and _is_candidate(folder / name, local)
        ]


def _is_candidate(path: Path, has_content: bool) -> bool:
    """True if an entry of a folder is to be mapped; damaged files are, to be reported.

    Args:
        path: a file or folder.
        has_content: else the names, of the file or in the folder, are all that is known.
    """
    if path.is_dir():
        matches = (known.matches(path, None) for known in FORMATS)
        is_known = is_recording(path) if has_content else any(matches)
        return is_known and not (path / "run.json").is_file()  # clouds of a result
    if path.name.lower().endswith(_SURE_ENDINGS):
        return True
    return is_recording(path) if has_content else path.name.lower().endswith(_USUAL_ENDINGS)
