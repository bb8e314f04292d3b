"""Options as frozen dataclasses with ranges, and overrides of them."""

import dataclasses
import sys
import types
import typing
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar, NamedTuple, TypeVar

from stillmap.core.errors import InputError, closest_match

T = TypeVar("T")

_MAX_INTEGER = 2**31 - 1  # the compiled core counts in 32 bits


class Limits(NamedTuple):
    """Range of a number: `ge` <= x <= `le`, `gt` < x < `lt`; None is no limit."""

    ge: float | None = None
    gt: float | None = None
    le: float | None = None
    lt: float | None = None

    def contain(self, value: float) -> bool:
        """True if a number lies within the range; NaN lies in no range that has a limit."""
        return (
            (self.ge is None or value >= self.ge)
            and (self.gt is None or value > self.gt)
            and (self.le is None or value <= self.le)
            and (self.lt is None or value < self.lt)
        )

    def __str__(self) -> str:
        if self.ge is not None and self.le is not None:
            return f"{self.ge:.10g} to {self.le:.10g}"
        words = ("at least", "more than", "at most", "less than")
        return " and ".join(
            f"{word} {limit:.10g}"
            for word, limit in zip(words, self, strict=True)
            if limit is not None
        )


def option(default: Any, doc: str, **limits: float) -> Any:
    """A dataclass field with the meaning, unit and range that `stillmap config` prints.

    Args:
        default: the default value; None where the option may be unset.
        doc: meaning and unit.
        limits: `ge`, `gt`, `le`, `lt`; see Limits.
    """
    return dataclasses.field(default=default, metadata={"doc": doc, "limits": Limits(**limits)})


class Section:
    """Base of the option dataclasses: checks the range of every `option` that is set.

    `class EmOptions(Section, section="em")` names the section in messages.

    Raises:
        ValueError: a value is outside its range, or `check` rejects it.
    """

    _section: ClassVar[str] = ""

    def __init_subclass__(cls, section: str = "", **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        cls._section = section

    def __post_init__(self) -> None:
        prefix = f"{self._section}." if self._section else ""
        for field in dataclasses.fields(self):  # type: ignore[arg-type]
            limits: Limits = field.metadata.get("limits", Limits())
            value = getattr(self, field.name)
            if value is not None and not limits.contain(value):
                raise ValueError(f"'{prefix}{field.name}' must be {limits}, got {value!r}")
        self.check()

    def check(self) -> None:
        """Checks relations between options; raises ValueError."""


def override(options: T, changes: Mapping[str, Any], where: str = "") -> T:
    """`options` with nested `changes` applied; every key, type and range is checked.

    Args:
        options: a frozen dataclass whose sections are dataclasses.
        changes: `{"em": {"prior": 0.9}}`, as TOML gives it.
        where: the file that `changes` came from, for messages.

    Raises:
        InputError: an unknown key (the message names the nearest one), a value of the wrong type,
            or one outside its range.
    """
    return _override(options, changes, where, "", options)


def _override(options: T, changes: Mapping[str, Any], where: str, prefix: str, top: Any) -> T:
    fields = {f.name: f for f in dataclasses.fields(options)}  # type: ignore[arg-type]
    hints = typing.get_type_hints(type(options))
    values: dict[str, Any] = {}
    for key, value in changes.items():
        name = f"{prefix}{key}"
        if key not in fields:
            near = closest_match(name, iter_names(top), min_similarity=0.0)
            raise InputError(f"unknown option '{name}'", where=where, hint=f"nearest: '{near}'")
        current = getattr(options, key)
        if dataclasses.is_dataclass(current):
            if not isinstance(value, Mapping):
                raise InputError(f"'{name}' is a section, not a value", where=where)
            values[key] = _override(current, value, where, f"{name}.", top)
        else:
            if isinstance(value, Mapping):
                raise InputError(f"'{name}' is a value, not a section", where=where)
            values[key] = _convert(value, hints[key], name, where)
    try:
        return dataclasses.replace(options, **values)  # type: ignore[type-var]
    except ValueError as error:
        raise InputError(str(error), where=where) from error


def _convert(value: Any, hint: Any, name: str, where: str) -> Any:
    """A value as the type hint of its option wants it."""
    for kind in _alternatives(hint):
        if value in _choices(kind) or (kind is type(None) and value is None):
            return value
        if typing.get_origin(kind) is tuple and isinstance(value, list | tuple):
            parts = typing.get_args(kind)
            if len(value) == len(parts):
                return tuple(
                    _convert(one, part, name, where) for one, part in zip(value, parts, strict=True)
                )
        if kind is float and isinstance(value, int | float) and not isinstance(value, bool):
            if not abs(value) <= sys.float_info.max:  # nan, inf, and integers beyond them
                what = f"'{name}' must be a finite number, got {_format(value)}"
                raise InputError(what, where=where)
            return float(value)
        if kind in (int, bool, str) and type(value) is kind:
            if kind is str and "\0" in value:
                raise InputError(f"'{name}' must hold no NUL", where=where)
            if kind is int and abs(value) > _MAX_INTEGER:
                raise InputError(f"'{name}' is too large: {_format(value)}", where=where)
            return value
    raise InputError(f"'{name}' must be {_type_name(hint)}, got {_format(value)}", where=where)


def _format(value: Any) -> str:
    try:
        return repr(value)
    except ValueError:  # Python writes no number of thousands of digits
        return "a huge number"


def _alternatives(hint: Any) -> tuple[Any, ...]:
    return typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)


def _choices(hint: Any) -> tuple[Any, ...]:
    return typing.get_args(hint) if typing.get_origin(hint) is typing.Literal else ()


def _type_name(hint: Any) -> str:
    if isinstance(hint, types.UnionType):
        return " or ".join(map(_type_name, _alternatives(hint)))
    if typing.get_origin(hint) is tuple:
        return f"a list of {len(typing.get_args(hint))} numbers"
    if choices := _choices(hint):
        return " | ".join(map(repr, choices))
    return "unset" if hint is type(None) else str(getattr(hint, "__name__", hint))


def nest(changes: Mapping[str, Any]) -> dict[str, Any]:
    """Nested dictionaries of dotted keys: `{"em": {"prior": 0.9}}` of `{"em.prior": 0.9}`."""
    out: dict[str, Any] = {}
    for key, value in changes.items():
        nested = value
        for name in reversed(key.split(".")):
            nested = {name: nested}
        out = merge_nested(out, nested)
    return out


def merge_nested(*changes: Mapping[str, Any]) -> dict[str, Any]:
    """Merges nested dictionaries; later ones win."""
    out: dict[str, Any] = {}
    for change in changes:
        for key, value in change.items():
            if isinstance(value, Mapping) and isinstance(out.get(key), Mapping):
                out[key] = merge_nested(out[key], value)
            else:
                out[key] = value
    return out


def to_dict(options: Any) -> dict[str, Any]:
    """Options as plain nested dictionaries."""
    return dataclasses.asdict(options)


class OptionInfo(NamedTuple):
    """One option.

    Attributes:
        name: as in `em.prior`.
        value, default: present and default value.
        kind: its type, in words.
        choices: allowed values; empty where there is a range or none.
        limits: range of a number.
        doc: meaning and unit.
    """

    name: str
    value: Any
    default: Any
    kind: str
    choices: tuple[Any, ...]
    limits: Limits
    doc: str


def iter_options(options: Any, prefix: str = "") -> Iterator[OptionInfo]:
    """All options, section by section; options of a section come before its sub-sections."""
    hints = typing.get_type_hints(type(options))
    fields, sections = _split_fields(options)
    for f in fields:
        kinds = _alternatives(hints[f.name])
        yield OptionInfo(
            name=f"{prefix}{f.name}",
            value=getattr(options, f.name),
            default=f.default,
            kind=" or ".join("str" if _choices(kind) else _type_name(kind) for kind in kinds),
            choices=tuple(choice for kind in kinds for choice in _choices(kind)),
            limits=f.metadata.get("limits", Limits()),
            doc=f.metadata.get("doc", ""),
        )
    for f in sections:
        yield from iter_options(getattr(options, f.name), f"{prefix}{f.name}.")


def iter_names(options: Any, prefix: str = "") -> Iterator[str]:
    """Names of all options and sections."""
    fields, sections = _split_fields(options)
    yield from (f"{prefix}{f.name}" for f in fields)
    for f in sections:
        yield f"{prefix}{f.name}"
        yield from iter_names(getattr(options, f.name), f"{prefix}{f.name}.")


def is_within(name: str, section: str) -> bool:
    """True if an option lies in a section, or has that name; "" holds all."""
    return not section or name == section or name.startswith(f"{section}.")


def _split_fields(options: Any) -> tuple[list[Any], list[Any]]:
    """Fields that are values, and those that are sections."""
    fields = dataclasses.fields(options)
    sections = [f for f in fields if dataclasses.is_dataclass(getattr(options, f.name))]
    return [f for f in fields if f not in sections], sections
