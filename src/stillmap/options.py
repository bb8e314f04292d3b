"""Options as frozen dataclasses: one default each, unknown keys refused, TOML in and out."""

import dataclasses
import difflib
import json
import sys
import tomllib
import types
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

from stillmap.errors import InputError

T = TypeVar("T")

_INTEGERS_BELOW = 2**31  # the compiled core counts in 32 bits


def field_with_doc(default: Any, doc: str) -> Any:
    """A dataclass field whose unit and meaning `stillmap config` prints."""
    return dataclasses.field(default=default, metadata={"doc": doc})


def replaced(options: T, changes: Mapping[str, Any], where: str = "") -> T:
    """`options` with nested `changes` applied; each key and type is checked.

    Args:
        options: a frozen dataclass, sections being dataclasses themselves.
        changes: `{"em": {"prior": 0.9}}`, as TOML gives it.
        where: the file that `changes` came from, for messages.

    Raises:
        InputError: an unknown key (the nearest one is named) or a value of the wrong type.
    """
    return _replaced(options, changes, where, "")


def _replaced(options: T, changes: Mapping[str, Any], where: str, prefix: str) -> T:
    fields = {f.name: f for f in dataclasses.fields(options)}  # type: ignore[arg-type]
    hints = typing.get_type_hints(type(options))
    values: dict[str, Any] = {}
    for key, value in changes.items():
        if key not in fields:
            near = difflib.get_close_matches(key, fields, n=1, cutoff=0.0)
            raise InputError(
                f"unknown option '{prefix}{key}'", where=where, hint=f"nearest: '{prefix}{near[0]}'"
            )
        current = getattr(options, key)
        if dataclasses.is_dataclass(current):
            if not isinstance(value, Mapping):
                raise InputError(f"'{prefix}{key}' is a section, not a value", where=where)
            values[key] = _replaced(current, value, where, f"{prefix}{key}.")
        else:
            values[key] = _coerced(value, hints[key], f"{prefix}{key}", where)
    try:
        return dataclasses.replace(options, **values)  # type: ignore[type-var]
    except ValueError as error:
        raise InputError(str(error), where=where) from error


def _coerced(value: Any, hint: Any, name: str, where: str) -> Any:
    choices = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
    for choice in choices:
        if typing.get_origin(choice) is typing.Literal and value in typing.get_args(choice):
            return value
        if choice is float and isinstance(value, int | float) and not isinstance(value, bool):
            if not abs(value) <= sys.float_info.max:  # nan, inf, and integers beyond them
                raise InputError(f"'{name}' wants a finite number, got {value}", where=where)
            return float(value)
        if choice in (int, bool, str) and type(value) is choice:
            if choice is int and abs(value) >= _INTEGERS_BELOW:
                raise InputError(f"'{name}' is too large: {value}", where=where)
            return value
        if choice is type(None) and value is None:
            return value
    wanted = " or ".join(_type_name(choice) for choice in choices)
    raise InputError(f"'{name}' wants {wanted}, got {value!r}", where=where)


def _type_name(hint: Any) -> str:
    if typing.get_origin(hint) is typing.Literal:
        return " | ".join(repr(value) for value in typing.get_args(hint))
    return "nothing" if hint is type(None) else str(getattr(hint, "__name__", hint))


def load_toml(path: Path) -> dict[str, Any]:
    """The nested dictionary of a TOML file."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=str(path)) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"is not TOML: {error}", where=str(path)) from error


def parse_assignment(text: str) -> dict[str, Any]:
    """`section.key=value` as a nested dictionary; the value as TOML, else as a string."""
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise InputError(f"--set wants section.key=value, got '{text}'")
    try:
        parsed = tomllib.loads(f"value = {value}")["value"]
    except (tomllib.TOMLDecodeError, RecursionError):
        parsed = value.strip()
    nested: dict[str, Any] = {}
    inner = nested
    *sections, last = key.strip().split(".")
    for section in sections:
        inner = inner.setdefault(section, {})
    inner[last] = parsed
    return nested


def merged(*changes: Mapping[str, Any]) -> dict[str, Any]:
    """Nested dictionaries laid over one another; later ones win."""
    out: dict[str, Any] = {}
    for change in changes:
        for key, value in change.items():
            if isinstance(value, Mapping) and isinstance(out.get(key), Mapping):
                out[key] = merged(out[key], value)
            else:
                out[key] = value
    return out


def to_dict(options: Any) -> dict[str, Any]:
    """The resolved options as plain nested dictionaries."""
    return dataclasses.asdict(options)


def to_toml(options: Any) -> str:
    """Every option with its value, unit and meaning, as TOML that `--config` reads back."""
    return "\n".join(_toml_lines(options, "")) + "\n"


def _toml_lines(options: Any, section: str) -> Iterator[str]:
    if section:
        yield f"\n[{section}]"
    fields = dataclasses.fields(options)
    nested = [f for f in fields if dataclasses.is_dataclass(getattr(options, f.name))]
    for f in fields:
        if f in nested:
            continue
        value = getattr(options, f.name)
        doc = f.metadata.get("doc", "")
        # TOML has no null: an option that is unset stands as a comment
        yield (
            f"# {f.name} is not set  # {doc}"
            if value is None
            else (f"{f.name} = {json.dumps(value)}  # {doc}")
        )
    for f in nested:
        yield from _toml_lines(getattr(options, f.name), f"{section}.{f.name}".lstrip("."))
