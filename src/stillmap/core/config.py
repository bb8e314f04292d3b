"""Options: frozen dataclasses that check their values, changes of them, and the same as TOML.

An option is a field with its default, range and meaning:

    @dataclass(frozen=True)
    class EmOptions(CheckedOptions):
        prior: float = option(0.9, "Prior probability p(c = 1) that a beam is static.", gt=0, lt=1)
"""

import dataclasses
import json
import math
import re
import tomllib
import types
import typing
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar

import msgspec
from msgspec import Meta

from stillmap.core.errors import InputError, closest_match
from stillmap.core.input_files import read_text

T = TypeVar("T")

_MAX_INTEGER = 2**31 - 1  # the compiled core counts in 32 bits

Count = Annotated[int, Meta(le=_MAX_INTEGER)]

_MAX_FILE_SIZE = 64 << 10  # bytes; Python needs minutes for more of nested keys

_BOUNDS = {"ge": "at least", "gt": "more than", "le": "at most", "lt": "less than"}
_LIMITS = (*_BOUNDS, "min_length", "max_length", "pattern")
_NOUNS = {bool: "true or false", int: "an integer", float: "a finite number", str: "a text"}


def option(default: Any, doc: str, **limits: Any) -> Any:
    """A field of checked options.

    Args:
        default: None where the option may be unset.
        doc: meaning and unit.
        limits: `ge`, `gt`, `le`, `lt`, and whatever else `msgspec.Meta` takes.
    """
    return dataclasses.field(default=default, metadata={"doc": doc, "limits": limits})


class OptionError(ValueError):
    """A value that an option cannot have.

    Attributes:
        name: of the option, without its section.
        what: what it must be, and what it is.
    """

    def __init__(self, name: str, what: str) -> None:
        self.name, self.what = name, what
        super().__init__(f"'{name}' {what}")


@dataclasses.dataclass(frozen=True)
class CheckedOptions:
    """Options, all of whose values are of their types and within their ranges.

    Raises:
        OptionError: one is not.
    """

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value, default = getattr(self, field.name), field.default
            if not dataclasses.is_dataclass(default):
                if value is not default:
                    declared = declared_options(type(self))[field.name]
                    object.__setattr__(self, field.name, _check(value, declared, field.name))
            elif not isinstance(value, type(default)):
                raise OptionError(field.name, f"must be {type(default).__name__}, got {value!r}")


class Declaration(NamedTuple):
    """Type, limits, default and documentation of an option.

    Attributes:
        kind: its type where it is set.
        is_optional: whether it may be unset.
        limits: by their names in `msgspec.Meta`.
        default: None: unset.
        doc: meaning and unit.
    """

    kind: Any
    is_optional: bool
    limits: dict[str, Any]
    default: Any
    doc: str

    @property
    def choices(self) -> tuple[Any, ...]:
        """Allowed values; empty where there is a range or none."""
        is_choice = typing.get_origin(self.kind) is typing.Literal
        return typing.get_args(self.kind) if is_choice else ()


def declared_options(kind: Any) -> dict[str, Declaration]:
    """The options of a class by name; sections are none, nor fields of a plain dataclass."""
    return _declare_all(kind) if issubclass(kind, CheckedOptions) else {}


@cache
def _declare_all(kind: type[CheckedOptions]) -> dict[str, Declaration]:
    hints = typing.get_type_hints(kind, include_extras=True)
    fields = [
        field for field in dataclasses.fields(kind) if not dataclasses.is_dataclass(field.default)
    ]
    return {field.name: _declare(field, hints[field.name]) for field in fields}


def _declare(field: dataclasses.Field[Any], hint: Any) -> Declaration:
    is_optional = typing.get_origin(hint) in (types.UnionType, typing.Union)
    kind, notes = typing.get_args(hint)[0] if is_optional else hint, list[Meta]()
    if typing.get_origin(kind) is Annotated:
        kind, *notes = typing.get_args(kind)
    limits = {
        key: limit for note in notes for key in _LIMITS if (limit := getattr(note, key)) is not None
    }
    limits |= field.metadata.get("limits", {})
    return Declaration(kind, is_optional, limits, field.default, field.metadata.get("doc", ""))


def _plain(value: Any) -> Any:
    """Numbers as floats, alone or in a list: NumPy's are of a subclass."""
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    return float(value) if isinstance(value, float) else value


def _check(value: Any, declared: Declaration, name: str) -> Any:
    """The value of an option as its type: integers as floats, lists as tuples.

    Raises:
        OptionError: it is of another type, or out of range.
    """
    if value is None and declared.is_optional:
        return None
    needed = " or ".join(map(repr, declared.choices)) or _NOUNS.get(declared.kind, "a list")
    with suppress(msgspec.ValidationError):
        checked = msgspec.convert(_plain(value), declared.kind)
        if not isinstance(checked, float) or math.isfinite(checked):
            needed = describe_range(declared.limits) or needed
            return msgspec.convert(checked, Annotated[declared.kind, Meta(**declared.limits)])
    raise OptionError(name, f"must be {needed}, got {_format(value)}")


class OptionInfo(NamedTuple):
    """One option.

    Attributes:
        name: as in `em.prior`.
        value, default: present and default value.
        kind: its type, in words.
        choices: allowed values; empty where there is a range or none.
        limits: range of a number, in words.
        doc: meaning and unit.
    """

    name: str
    value: Any
    default: Any
    kind: str
    choices: tuple[Any, ...]
    limits: str
    doc: str


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
    values: dict[str, Any] = {}
    known = {*declared_options(type(options)), *_section_names(options)}
    for key, value in changes.items():
        name = f"{prefix}{key}"
        if not isinstance(key, str) or key not in known:
            near = closest_match(name, iter_names(top), min_similarity=0.0)
            raise InputError(f"unknown option '{name}'", where=where, hint=f"nearest: '{near}'")
        current = getattr(options, key)
        is_section = dataclasses.is_dataclass(current)
        if is_section != isinstance(value, Mapping):
            what = "a section, not a value" if is_section else "a value, not a section"
            raise InputError(f"'{name}' is {what}", where=where)
        values[key] = _override(current, value, where, f"{name}.", top) if is_section else value
    try:
        return dataclasses.replace(options, **values)  # type: ignore[type-var]
    except OptionError as error:
        raise InputError(f"'{prefix}{error.name}' {error.what}", where=where) from error
    except ValueError as error:  # of a check between options, which names them
        raise InputError(str(error), where=where) from error


def _format(value: Any) -> str:
    try:
        text = repr(value)
    except ValueError:  # Python writes no number of thousands of digits
        return "a huge number"
    return text if len(text) < 80 else f"{text[:76]} ..."


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


def iter_options(options: Any, prefix: str = "") -> Iterator[OptionInfo]:
    """All options, section by section; options of a section come before its sub-sections."""
    for name, declared in declared_options(type(options)).items():
        is_list = typing.get_origin(declared.kind) is tuple
        kind = "list" if is_list else getattr(declared.kind, "__name__", "str")
        kind = ("str" if declared.choices else kind) + " or unset" * (declared.default is None)
        # what every integer has to fit into is no range
        limits = describe_range({k: v for k, v in declared.limits.items() if v != _MAX_INTEGER})
        value = getattr(options, name)
        yield OptionInfo(
            f"{prefix}{name}", value, declared.default, kind, declared.choices, limits, declared.doc
        )
    for name in _section_names(options):
        yield from iter_options(getattr(options, name), f"{prefix}{name}.")


def describe_range(limits: Mapping[str, Any]) -> str:
    """The range of a number in words; empty where there is none."""
    parts = (f"{words} {limits[key]:.10g}" for key, words in _BOUNDS.items() if key in limits)
    return " and ".join(parts)


def iter_names(options: Any) -> Iterator[str]:
    """Names of all options and sections."""
    sections = dict[str, None]()
    for info in iter_options(options):
        yield info.name
        sections[info.name.rpartition(".")[0]] = None
    yield from filter(None, sections)


def is_within(name: str, section: str) -> bool:
    """True if an option lies in a section, or has that name; "" holds all."""
    return not section or name == section or name.startswith(f"{section}.")


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
        parsed = tomllib.loads(f"value = {value}")
    except (ValueError, RecursionError):
        parsed = {}
    # more than one key: the value had several lines, and only looked like TOML
    wanted = parsed["value"] if len(parsed) == 1 else _number_or_text(value.strip())
    return nest({key.strip(): wanted})


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
        near = closest_match(only, known, min_similarity=0.0)
        raise InputError(f"there is no option or section '{only}'", hint=f"nearest: '{near}'")
    return "\n".join(_toml_lines(options, only)).lstrip("\n") + "\n"


def _toml_lines(options: Any, only: str) -> Iterator[str]:
    section = ""
    for option in iter_options(options):
        if not is_within(option.name, only):
            continue
        before, (section, _, key) = section, option.name.rpartition(".")
        if section != before:
            yield from _heading(options, section)
        # a description that explains every choice lists them already
        explained = all(str(choice) in option.doc for choice in option.choices)
        allowed = option.limits if explained else " | ".join(map(str, option.choices))
        doc = option.doc + (f" ({allowed})" if allowed else "")
        # TOML has no null: an option that is unset becomes a comment
        is_unset = option.value is None
        start = f"# {key} is not set" if is_unset else f"{key} = {_toml_value(option.value)}"
        yield f"{start}  # {doc}"


def _toml_value(value: Any) -> str:
    # TOML has neither JSON's pairs of escapes for one character nor a bare DEL
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _heading(options: Any, section: str) -> Iterator[str]:
    for name in section.split("."):
        options = getattr(options, name)
    summary = (type(options).__doc__ or "").partition("\n")[0]
    yield from ("", f"# {summary}", f"[{section}]")


def _section_names(options: Any) -> list[str]:
    names = [field.name for field in dataclasses.fields(options)]
    return [name for name in names if dataclasses.is_dataclass(getattr(options, name))]
