"""The one exception that stands for bad input or a bad call.

Libraries that only some formats and models need.
"""

import re
from collections.abc import Iterable
from importlib import import_module
from typing import Any

_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f]")

_LONGEST = 1000  # letters of a line: what a damaged file holds is no reading matter


class InputError(Exception):
    """Input or call at fault: says what is wrong, where, and what to do.

    The command line prints it as one line and exits with status 2.

    Args:
        what: what is wrong.
        where: file and position (`log.clf:17`), empty when there is none.
        hint: what the user can do about it, empty when there is nothing to add.
    """

    def __init__(self, what: str, *, where: str = "", hint: str = "") -> None:
        self.what = _short(what)
        self.where = where
        self.hint = _short(hint)
        super().__init__(str(self))

    def __str__(self) -> str:
        place = f"{self.where}: " if self.where else ""
        advice = f" ({self.hint})" if self.hint else ""
        line = f"{place}{self.what}{advice}".replace("\n", " ")
        # names in files and of files may hold what a terminal obeys
        return _CONTROL.sub(lambda found: f"\\x{ord(found[0]):02x}", line)


def _short(text: str) -> str:
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."


def closest_match(word: str, known: Iterable[str], min_similarity: float = 0.6) -> str | None:
    """The known word most like `word`, for hints; None where none is like it.

    Args:
        word: what was written.
        known: what could have been meant.
        least: how much alike they have to be, 0 (anything is) to 1 (the same).
    """
    from difflib import get_close_matches  # only where something went wrong

    originals = {one.lower(): one for one in known}
    found = get_close_matches(word.lower(), originals, n=1, cutoff=min_similarity)
    return originals[found[0]] if found else None


class MissingExtra(InputError):
    """A library is not there: no file at fault, and none that could be skipped for it."""


def import_extra(module: str, path: object, action: str = "read", *, group: str = "io") -> Any:
    """A module that comes with one of stillmap's extras.

    Args:
        module: what to import.
        path: what it is wanted for.
        to_be: what is to be done with it.
        group: the extra.

    Raises:
        MissingExtra: it is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        hint = f"pip install 'stillmap[{group}]'"
        raise MissingExtra(f"needs {package} to be {action}", where=str(path), hint=hint) from error
