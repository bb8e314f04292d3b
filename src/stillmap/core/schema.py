"""Checks of values that were read from JSON against the types that they are to have.

A type is a type hint: `bool`, `int`, `float`, `str`, `None`, `Any`, unions, `Literal`, `list[X]`,
`tuple[X, Y]` (a list of that length), `dict[str, X]`, a TypedDict (keys that it does not name are
kept as they are), and `Annotated[X, Limits(...)]` for numbers with a range. Integers fit into 64
bits, and numbers are finite; `float` takes integers, too.
"""

import math
import types
import typing
from collections.abc import Mapping
from typing import Any

from stillmap.core.config import Limits

_MAX_INTEGER = 2**63 - 1
_Plain = (bool, int, float, str)


class SchemaError(ValueError):
    """A value has another type, or lies outside of its range; names its key."""


def check(value: Any, kind: Any, name: str = "") -> None:
    """Refuse a value of another type.

    Args:
        value: as JSON gives it.
        kind: its type, see above.
        name: of the value, for the message.

    Raises:
        SchemaError: it does not fit.
    """
    origin, parts = typing.get_origin(kind), typing.get_args(kind)
    if kind is Any:
        return
    if origin is typing.Annotated:
        _check_number(value, parts[0], parts[1], name)
    elif origin in (typing.Union, types.UnionType):
        if not any(fits(value, part) for part in parts):
            raise _error(value, kind, name)
    elif origin is typing.Literal:
        if not any(value == part and type(value) is type(part) for part in parts):
            raise _error(value, kind, name)
    elif origin is list or origin is tuple:
        _check_items(value, kind, name)
    elif origin is dict or typing.is_typeddict(kind):
        _check_keys(value, kind, name)
    else:
        _check_plain(value, kind, name)


def fits(value: Any, kind: Any) -> bool:
    """True if a value is of a type."""
    try:
        check(value, kind)
    except SchemaError:
        return False
    return True


def prune(value: Mapping[str, Any], kind: Any) -> dict[str, Any]:
    """A mapping without the entries that do not fit a TypedDict, at any depth.

    For notes of other programs, of which nothing depends.
    """
    hints = typing.get_type_hints(kind, include_extras=True)
    out = {}
    for key, one in value.items():
        hint = _inner(hints.get(key, Any))
        kept = _prune_one(one, hint)
        if fits(kept, hint):
            out[key] = kept
    return out


def _prune_one(value: Any, kind: Any) -> Any:
    origin, parts = typing.get_origin(kind), typing.get_args(kind)
    if typing.is_typeddict(kind) and isinstance(value, dict):
        return prune(value, kind)
    if origin is list and isinstance(value, list):
        return [_prune_one(one, parts[0]) for one in value]
    if origin is dict and isinstance(value, dict):
        pruned = {key: _prune_one(one, parts[1]) for key, one in value.items()}
        return {key: one for key, one in pruned.items() if fits(one, parts[1])}
    return value


def _inner(kind: Any) -> Any:
    """The type of an entry that may be missing."""
    required = (typing.NotRequired, typing.Required)
    return typing.get_args(kind)[0] if typing.get_origin(kind) in required else kind


def _check_plain(value: Any, kind: Any, name: str) -> None:
    if kind in (None, type(None)):
        is_right = value is None
    elif kind is float:
        is_right = isinstance(value, int | float) and not isinstance(value, bool)
        is_right = (is_right and abs(value) <= _MAX_INTEGER) or (is_right and _is_finite(value))
    elif kind is int:
        is_right = type(value) is int and abs(value) <= _MAX_INTEGER
    else:
        is_right = type(value) is kind
    if not is_right:
        raise _error(value, kind, name)


def _is_finite(value: float) -> bool:
    return isinstance(value, float) and math.isfinite(value)


def _check_number(value: Any, kind: Any, limits: Limits, name: str) -> None:
    check(value, kind, name)
    if value is not None and not limits.contain(value):
        raise SchemaError(f"'{name}' must be {limits}, got {value!r}")


def _check_items(value: Any, kind: Any, name: str) -> None:
    parts = typing.get_args(kind)
    if not isinstance(value, list):
        raise _error(value, kind, name)
    if typing.get_origin(kind) is tuple:
        if len(value) != len(parts):
            raise _error(value, kind, name)
    else:
        parts = (parts[0],) * len(value)
    for number, (one, part) in enumerate(zip(value, parts, strict=True)):
        check(one, part, f"{name}[{number}]")


def _check_keys(value: Any, kind: Any, name: str) -> None:
    if not isinstance(value, dict):
        raise _error(value, kind, name)
    if not typing.is_typeddict(kind):
        for key, one in value.items():
            check(one, typing.get_args(kind)[1], f"{name}.{key}" if name else key)
        return
    hints = typing.get_type_hints(kind, include_extras=True)
    for key, hint in hints.items():
        if key in value:
            check(value[key], _inner(hint), f"{name}.{key}" if name else key)
        elif key in kind.__required_keys__:
            raise SchemaError(f"'{name}.{key}' is missing" if name else f"'{key}' is missing")


def _error(value: Any, kind: Any, name: str) -> SchemaError:
    shown = repr(value)
    shown = f"{shown[:60]}..." if len(shown) > 63 else shown
    return SchemaError(f"'{name}' must be {_words(kind)}, got {shown}")


def _words(kind: Any) -> str:
    origin, parts = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(map(_words, parts))
    if origin is typing.Literal:
        return " | ".join(map(repr, parts))
    if origin is typing.Annotated:
        return _words(parts[0])
    if origin is tuple:
        return f"a list of {len(parts)}"
    if origin is list:
        return "a list"
    if origin is dict or typing.is_typeddict(kind):
        return "an object"
    words = {bool: "true or false", int: "an integer", float: "a number", str: "text"}
    return words.get(kind, "null")
