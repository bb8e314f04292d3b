"""Paths and URLs through fsspec; names that come from outside."""

import hashlib
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from stillmap.core.errors import InputError, MissingExtra, import_extra


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
    """Whether a path or URL lies in the file system of this machine."""
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
    """What fsspec knows of each file at and below a path or URL, by its name relative to it.

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


def hash_content(url: str) -> tuple[str, int]:
    """A digest of the names and contents of the files of a recording, and their bytes.

    At a URL the ETags, or what else the storage knows of a version, stand for the contents.

    Raises:
        InputError: it cannot be read.
    """
    fs, whole, size = open_location(url)[0], hashlib.sha256(), 0
    for name, about in list_files(url).items():
        with explain(url, "read"):
            if is_local(url):
                with fs.open(about["name"]) as file:
                    version = hashlib.file_digest(file, "sha256").hexdigest()
            else:
                version = about.get("ETag") or fs.ukey(about["name"])
        whole.update(repr((name, version)).encode())
        size += about["size"]
    return whole.hexdigest(), size


def is_component(name: str) -> bool:
    """Whether a name from outside is one component of a path, and leads nowhere else."""
    return name not in ("", ".", "..") and not any(c in "/\\\0" for c in name)


def is_folder_name(name: str) -> bool:
    """Whether a text is fit for a folder's name everywhere."""
    plain = re.sub(r"[-_. ]", "", name)
    return plain.isalnum() and name[0] not in ".-" and len(name.encode()) <= 200
