"""Options as frozen dataclasses: one default each, unknown keys refused, TOML in and out."""

import dataclasses
import json
import re
import sys
import tomllib
import types
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, TypeVar

from stillmap.core.errors import InputError, closest_match
from stillmap.core.files import read_text

T = TypeVar("T")

_INTEGERS_BELOW = 2**31  # the compiled core counts in 32 bits
_LARGEST = 64 << 10  # bytes of a file: of nested keys, more take Python minutes


class Limits(NamedTuple):
    """Range of a number: `ge` <= x <= `le`, `gt` < x < `lt`; None is no limit."""

    ge: float | None = None
    gt: float | None = None
    le: float | None = None
    lt: float | None = None

    def contain(self, value: float) -> bool:
        """Whether a number lies within the range; NaN lies in no range that has a limit."""
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


def option(
    default: Any,
    doc: str,
    *,
    ge: float | None = None,
    gt: float | None = None,
    le: float | None = None,
    lt: float | None = None,
) -> Any:
    """A dataclass field with the meaning, unit and range that `stillmap config` prints.

    Args:
        default: the default value; None where the option may be unset.
        doc: meaning and unit.
        ge: smallest value allowed.
        gt: the value must be greater.
        le: largest value allowed.
        lt: the value must be less.
    """
    return dataclasses.field(
        default=default, metadata={"doc": doc, "limits": Limits(ge, gt, le, lt)}
    )


class Section:
    """Base of the option dataclasses: checks the range of every `option` that is set.

    `class EmOptions(Section, section="em")` names the section in messages.

    Raises:
        ValueError: a value is outside its range, or `check` refuses it.
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


def replaced(options: T, changes: Mapping[str, Any], where: str = "") -> T:
    """`options` with nested `changes` applied; each key and type is checked.

    Args:
        options: a frozen dataclass, sections being dataclasses themselves.
        changes: `{"em": {"prior": 0.9}}`, as TOML gives it.
        where: the file that `changes` came from, for messages.

    Raises:
        InputError: an unknown key (the nearest one is named) or a value of the wrong type.
    """
    return _replaced(options, changes, where, "", options)


def _replaced(options: T, changes: Mapping[str, Any], where: str, prefix: str, top: Any) -> T:
    fields = {f.name: f for f in dataclasses.fields(options)}  # type: ignore[arg-type]
    hints = typing.get_type_hints(type(options))
    values: dict[str, Any] = {}
    for key, value in changes.items():
        if key not in fields:
            name = f"{prefix}{key}"
            near = closest_match(name, names(top), min_similarity=0.0)
            raise InputError(f"unknown option '{name}'", where=where, hint=f"nearest: '{near}'")
        current = getattr(options, key)
        if dataclasses.is_dataclass(current):
            if not isinstance(value, Mapping):
                raise InputError(f"'{prefix}{key}' is a section, not a value", where=where)
            values[key] = _replaced(current, value, where, f"{prefix}{key}.", top)
        else:
            if isinstance(value, Mapping):
                raise InputError(f"'{prefix}{key}' is a value, not a section", where=where)
            values[key] = _coerced(value, hints[key], f"{prefix}{key}", where)
    try:
        return dataclasses.replace(options, **values)  # type: ignore[type-var]
    except ValueError as error:
        raise InputError(str(error), where=where) from error


def _coerced(value: Any, hint: Any, name: str, where: str) -> Any:
    for choice in _alternatives(hint):
        if typing.get_origin(choice) is typing.Literal and value in typing.get_args(choice):
            return value
        if choice is float and isinstance(value, int | float) and not isinstance(value, bool):
            if not abs(value) <= sys.float_info.max:  # nan, inf, and integers beyond them
                what = f"'{name}' wants a finite number, got {_shown(value)}"
                raise InputError(what, where=where)
            return float(value)
        if choice in (int, bool, str) and type(value) is choice:
            if choice is int and abs(value) >= _INTEGERS_BELOW:
                raise InputError(f"'{name}' is too large: {_shown(value)}", where=where)
            return value
        if choice is type(None) and value is None:
            return value
    raise InputError(f"'{name}' wants {_type_name(hint)}, got {_shown(value)}", where=where)


def _shown(value: Any) -> str:
    try:
        return repr(value)
    except ValueError:  # Python writes no number of thousands of digits
        return "a huge number"


def _alternatives(hint: Any) -> tuple[Any, ...]:
    return typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)


def _type_name(hint: Any) -> str:
    if isinstance(hint, types.UnionType):
        return " or ".join(map(_type_name, _alternatives(hint)))
    if typing.get_origin(hint) is typing.Literal:
        return " | ".join(repr(value) for value in typing.get_args(hint))
    return "nothing" if hint is type(None) else str(getattr(hint, "__name__", hint))


def load_toml(path: Path) -> dict[str, Any]:
    """The nested dictionary of a TOML file.

    Raises:
        InputError: it cannot be read, is no TOML, or is too large for a file of options.
    """
    try:
        return tomllib.loads(read_text(path, _LARGEST))
    except (ValueError, RecursionError) as error:  # ValueError: numbers of thousands of digits too
        line = re.search(r" \(at line (\d+), column \d+\)$", str(error))
        what = str(error)[: line.start()] if line else str(error)
        where = f"{path}:{line[1]}" if line else str(path)
        raise InputError(f"is not TOML: {what}", where=where) from error


def parse_assignment(text: str) -> dict[str, Any]:
    """`section.key=value` as a nested dictionary; the value as TOML, else as a string.

    Numbers may lack a zero that TOML wants, as in `.5`.
    """
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise InputError(f"--set wants section.key=value, got '{text}'")
    try:
        read = tomllib.loads(f"value = {value}")
    except (ValueError, RecursionError):
        read = {}
    # more than one key: the value had several lines, and only looked like TOML
    parsed = read["value"] if len(read) == 1 else _number_or_text(value.strip())
    nested: dict[str, Any] = {}
    inner = nested
    *sections, last = key.strip().split(".")
    for section in sections:
        inner = inner.setdefault(section, {})
    inner[last] = parsed
    return nested


def _number_or_text(value: str) -> float | str:
    return float(value) if re.fullmatch(r"[+-]?(\d+\.|\.\d+)(e[+-]?\d+)?", value, re.I) else value


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


class Described(NamedTuple):
    """One option; `name` as in `em.prior`, `doc` with its meaning and unit."""

    name: str
    value: Any
    default: Any
    kind: str
    choices: tuple[Any, ...]
    limits: Limits
    doc: str


def described(options: Any, prefix: str = "") -> Iterator[Described]:
    """Every option of `options`, section by section, the sections' own last."""
    hints = typing.get_type_hints(type(options))
    fields, sections = _fields(options)
    for f in fields:
        hint = hints[f.name]
        choices = [c for one in _alternatives(hint) for c in _choices(one)]
        kind = " or ".join(
            "str" if _choices(one) else _type_name(one) for one in _alternatives(hint)
        )
        value, doc = getattr(options, f.name), f.metadata.get("doc", "")
        limits = f.metadata.get("limits", Limits())
        yield Described(f"{prefix}{f.name}", value, f.default, kind, tuple(choices), limits, doc)
    for f in sections:
        yield from described(getattr(options, f.name), f"{prefix}{f.name}.")


def names(options: Any, prefix: str = "") -> Iterator[str]:
    """The names of all options and sections."""
    fields, sections = _fields(options)
    yield from (f"{prefix}{f.name}" for f in fields)
    for f in sections:
        yield f"{prefix}{f.name}"
        yield from names(getattr(options, f.name), f"{prefix}{f.name}.")


def is_within(name: str, section: str) -> bool:
    """Whether an option is of that section, or is the one of that name; "": all are."""
    return not section or name == section or name.startswith(f"{section}.")


def _fields(options: Any) -> tuple[list[Any], list[Any]]:
    """Its fields that are values, and those that are sections."""
    fields = dataclasses.fields(options)
    sections = [f for f in fields if dataclasses.is_dataclass(getattr(options, f.name))]
    return [f for f in fields if f not in sections], sections


def _choices(hint: Any) -> tuple[Any, ...]:
    return typing.get_args(hint) if typing.get_origin(hint) is typing.Literal else ()


def to_toml(options: Any, only: str = "") -> str:
    """Every option with its value, unit and meaning, as TOML that `--config` reads back.

    Args:
        options: see `replaced`.
        only: name of the section or of the option that is wanted; "": all.

    Raises:
        InputError: there is neither section nor option of that name.
    """
    if only and only not in (known := list(names(options))):
        raise InputError(
            f"there is no option or section '{only}'",
            hint=f"nearest: '{closest_match(only, known, min_similarity=0.0)}'",
        )
    return "\n".join(_toml_lines(options, only)).lstrip("\n") + "\n"


def _toml_lines(options: Any, only: str) -> Iterator[str]:
    section = ""
    for one in described(options):
        if not is_within(one.name, only):
            continue
        before, (section, _, key) = section, one.name.rpartition(".")
        if section != before:
            yield from _heading(options, section)
        # what may be chosen stands in the meaning already where that says what each choice does
        listed = any(str(choice) not in one.doc for choice in one.choices)
        allowed = " | ".join(map(str, one.choices)) if listed else str(one.limits)
        doc = one.doc + (f" ({allowed})" if allowed else "")
        # TOML has no null: an option that is unset stands as a comment
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
    said = (type(options).__doc__ or "").partition("\n")[0]
    if not said.startswith(f"{type(options).__name__}("):  # what dataclasses say by themselves
        yield f"# {said}"
    yield f"[{section}]"
