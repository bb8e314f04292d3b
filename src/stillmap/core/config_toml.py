"""Options as TOML: files of them, single assignments of the command line, and the list of all."""

import json
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from stillmap.core.config import is_within, iter_names, iter_options, nest
from stillmap.core.errors import InputError, closest_match
from stillmap.core.input_files import read_text

_MAX_FILE_SIZE = 64 << 10  # bytes; Python needs minutes for more of nested keys


def load_toml(path: Path) -> dict[str, Any]:
    """Reads a TOML file.

    Raises:
        InputError: it cannot be read, is not TOML, or is too large for a file of options.
    """
    try:
        return tomllib.loads(read_text(path, _MAX_FILE_SIZE))
    except (ValueError, RecursionError) as error:  # ValueError: numbers of thousands of digits too
        line = re.search(r" \(at line (\d+), column \d+\)$", str(error))
        what = str(error)[: line.start()] if line else str(error)
        where = f"{path}:{line[1]}" if line else str(path)
        raise InputError(f"is not TOML: {what}", where=where) from error


def parse_assignment(text: str) -> dict[str, Any]:
    """Parses `section.key=value` to a nested dictionary; the value is TOML, else a string.

    Numbers may lack a zero that TOML requires, as in `.5`.
    """
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise InputError(f"an option is set by section.key=value, got '{text}'")
    try:
        found = tomllib.loads(f"value = {value}")
    except (ValueError, RecursionError):
        found = {}
    # more than one key: the value had several lines, and only looked like TOML
    return nest(
        {key.strip(): found["value"] if len(found) == 1 else _number_or_text(value.strip())}
    )


def _number_or_text(value: str) -> float | str:
    return float(value) if re.fullmatch(r"[+-]?(\d+\.|\.\d+)(e[+-]?\d+)?", value, re.I) else value


def to_toml(options: Any, only: str = "") -> str:
    """All options with value, meaning and range, as TOML that `--config` reads back.

    Args:
        options: see `override`.
        only: name of a section or option; "": all.

    Raises:
        InputError: there is no section or option of that name.
    """
    if only and only not in (known := list(iter_names(options))):
        raise InputError(
            f"there is no option or section '{only}'",
            hint=f"nearest: '{closest_match(only, known, min_similarity=0.0)}'",
        )
    return "\n".join(_toml_lines(options, only)).lstrip("\n") + "\n"


def _toml_lines(options: Any, only: str) -> Iterator[str]:
    section = ""
    for one in iter_options(options):
        if not is_within(one.name, only):
            continue
        before, (section, _, key) = section, one.name.rpartition(".")
        if section != before:
            yield from _heading(options, section)
        # a doc that explains every choice lists them already
        explained = all(str(choice) in one.doc for choice in one.choices)
        allowed = str(one.limits) if explained else " | ".join(map(str, one.choices))
        doc = one.doc + (f" ({allowed})" if allowed else "")
        # TOML has no null: an option that is unset becomes a comment
        yield (
            f"# {key} is not set  # {doc}"
            if one.value is None
            else f"{key} = {_toml_value(one.value)}  # {doc}"
        )


def _toml_value(value: Any) -> str:
    # TOML has neither JSON's pairs of escapes for one character nor a bare DEL
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _heading(options: Any, section: str) -> Iterator[str]:
    for name in section.split("."):
        options = getattr(options, name)
    yield ""
    summary = (type(options).__doc__ or "").partition("\n")[0]
    if not summary.startswith(f"{type(options).__name__}("):  # written by dataclasses
        yield f"# {summary}"
    yield f"[{section}]"
