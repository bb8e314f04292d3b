"""InputError, the one exception for invalid input or calls, and import of optional libraries."""

import errno
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

_MARK = "; what to do: "


def advise(what: str, todo: str) -> str:
    """A warning that ends with advice."""
    return f"{what}{_MARK}{todo}"


def split_advice(warning: str) -> tuple[str, str]:
    """A warning split in its cause and its remedy, which is empty where nothing has to be done."""
    what, _, todo = warning.partition(_MARK)
    return what, todo


def printable(text: str) -> str:
    """The text on one line, with characters that are not printed as escapes.

    Names of files, topics and frames may hold any, with which a terminal changes its colors, its
    title or lines above, or the order of characters.
    """
    shown = (c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    return "".join(shown)


def install_command(group: str) -> str:
    """The pip command that adds an extra; the package is on no index, so it names the clone."""
    return f"in a clone of stillmap: pip install '.[{group}]'"


_MAX_LENGTH = 1000  # characters of a message: damaged files may hold long words


class InputError(Exception):
    """Invalid input or call; the command line prints it as one line and exits with status 2.

    Args:
        what: the fault.
        where: file and position (`log.clf:17`), or empty.
        hint: a remedy, or empty.
    """

    def __init__(self, what: str, *, where: str = "", hint: str = "") -> None:
        self.what = _truncate(what)
        self.where = where
        self.hint = _truncate(hint)
        super().__init__(str(self))

    def __str__(self) -> str:
        place = f"{self.where}: " if self.where else ""
        advice = f" ({self.hint})" if self.hint else ""
        return printable(f"{place}{self.what}{advice}".replace("\n", " "))


@contextmanager
def explaining_refusal(path: object) -> Iterator[None]:
    """Within this context, what the system refuses to write is an error of the output `path`.

    Raises:
        InputError: it refused.
    """
    try:
        yield
    except OSError as error:
        what = f"cannot be written: {error.strerror or error}"
        raise InputError(what, where=str(path)) from error


@contextmanager
def explaining_damage(
    path: object, *kinds: type[Exception], what: str = "is damaged", hint: str = ""
) -> Iterator[None]:
    """Within this context, errors of these kinds, and any ValueError, are those of a damaged file.

    Raises:
        InputError: such an error occurred; `what` stands before its text.
    """
    expected: tuple[type[Exception], ...] = (ValueError, *kinds)
    try:
        yield
    except expected as error:
        raise InputError(f"{what}: {error}", where=str(path), hint=hint) from error


def _truncate(text: str) -> str:
    return text if len(text) <= _MAX_LENGTH else f"{text[: _MAX_LENGTH - 3]}..."


def closest_match(word: str, known: Iterable[str], min_similarity: float = 0.6) -> str | None:
    """The known word most similar to `word`, for hints; None where none is similar.

    Args:
        word: the word given.
        known: the valid words.
        min_similarity: 0 (any) to 1 (equal).
    """
    from difflib import get_close_matches  # only for messages

    originals = {name.lower(): name for name in known}
    matches = get_close_matches(word.lower(), originals, n=1, cutoff=min_similarity)
    return originals[matches[0]] if matches else None


class MissingExtra(InputError):
    """An optional library is not installed: no file is at fault, none is to be skipped."""


def import_extra(module: str, path: object, action: str = "read", *, group: str = "io") -> Any:
    """Import a module of one of stillmap's optional dependencies.

    Args:
        module: name of the module.
        path: the file that needs it.
        action: participle of the operation on the file, for the message.
        group: name of the extra.

    Raises:
        MissingExtra: it is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        what = f"needs {package} to be {action}"
        raise MissingExtra(what, where=str(path), hint=install_command(group)) from error


def is_out_of_memory(error: BaseException) -> bool:
    """True if memory ran out, whichever library says so."""
    if isinstance(error, OSError):
        return error.errno == errno.ENOMEM
    no_thread = isinstance(error, RuntimeError) and "start new thread" in str(error)
    return no_thread or isinstance(error, MemoryError)


def memory_error(error: BaseException) -> InputError:
    """The error for memory that ran out."""
    hint = "coarser slam.resolution, a shorter read.max_range or a part of the recording takes less"
    return InputError(f"not enough memory{': ' if str(error) else ''}{error}", hint=hint)
