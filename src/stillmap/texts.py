"""Text files of bounded size: a name may lead to a device that never ends, or to a pipe."""

from pathlib import Path

from stillmap.errors import InputError


def read_text(path: Path, largest: int) -> str:
    """The text of a file in UTF-8, of `largest` bytes at most.

    Raises:
        InputError: it cannot be read, or is larger.
        UnicodeDecodeError: it is no such text.
    """
    try:
        with path.open("rb") as file:
            content = file.read(largest + 1)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=str(path)) from error
    if len(content) > largest:
        raise InputError(f"is too large: more than {largest >> 10} KiB", where=str(path))
    return content.decode("utf-8")


def require_regular(path: Path) -> None:
    """Refuse pipes and devices that lie where a file should: reading may wait for ever.

    A folder, or what is not there at all, is left to who opens it.

    Raises:
        InputError: there is something else than a file.
    """
    if path.exists() and not path.is_file() and not path.is_dir():
        raise InputError("is no regular file", where=str(path))
