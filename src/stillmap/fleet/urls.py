"""Paths and URLs of recordings and results."""

import os
import re

from stillmap.core.errors import InputError

_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://")
_GLOB = re.compile(r"[*?[]")
# endings that are left out of a name, one after the other
_ENDINGS = re.compile(
    r"(\.(log|clf|txt|gz|bag|db3|mcap|pcd|ply|las|laz|e57|3d|zstd|zst))+$", re.IGNORECASE
)


def is_url(text: str) -> bool:
    """Whether a text names something elsewhere.

    Raises:
        InputError: a URL of a kind that is not supported.
    """
    if not _SCHEME.match(text):
        return False
    if not re.match(r"s3://[^/:]+(/|$)", text) or "::" in text:
        raise InputError("only paths and s3://BUCKET/... are supported", where=text)
    return True


def has_wildcards(text: str) -> bool:
    """Whether a text is a pattern: * ? or [ in it."""
    return _GLOB.search(text) is not None


def make_absolute(text: str) -> str:
    """A path that means the same in every working directory; URLs as they are."""
    return text.rstrip("/") if is_url(text) else os.path.abspath(text)


def short_name(text: str) -> str:
    """The last part of a path or URL without the endings of recordings, fit for a folder's name."""
    stem = text.rstrip("/").rpartition("/")[2]
    stem = _ENDINGS.sub("", stem) or stem
    return re.sub(r"[^\w.-]", "_", stem).lstrip(".-") or "recording"


def make_unique(name: str, taken: set[str]) -> str:
    """`name`, or `name-2`, `name-3`, ... where it is taken; case does not matter."""
    found, number = name, 1
    while found.casefold() in taken:
        number += 1
        found = f"{name}-{number}"
    taken.add(found.casefold())
    return found
