"""Options: frozen pydantic dataclasses, changes of them, and the same as TOML.

An option is a field with its default, range and meaning:

    @dataclass(frozen=True, config=STRICT)
    class EmOptions:
        prior: float = option(0.9, "Prior probability p(c = 1) that a beam is static.", gt=0, lt=1)
"""

import dataclasses
import json
import re
import tomllib
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar

from pydantic import ConfigDict, Field, ValidationError
from pydantic.fields import FieldInfo

from stillmap.core.errors import InputError, closest_match
from stillmap.core.input_files import read_text

T = TypeVar("T")

STRICT = ConfigDict(strict=True, allow_inf_nan=False, extra="forbid")

_MAX_INTEGER = 2**31 - 1  # the compiled core counts in 32 bits

Count = Annotated[int, Field(le=_MAX_INTEGER)]

_MAX_FILE_SIZE = 64 << 10  # bytes; Python needs minutes for more of nested keys


def option(default: Any, doc: str, **limits: Any) -> Any:
    """A field of a pydantic dataclass.

    Args:
        default: None where the option may be unset.
        doc: meaning and unit.
        limits: `ge`, `gt`, `le`, `lt`, and whatever else `pydantic.Field` takes.
    """
    return Field(default=default, description=doc, **limits)


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
    for key, value in changes.items():
        name = f"{prefix}{key}"
        if not isinstance(key, str) or key not in _names(options):
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
    except ValidationError as error:
        raise InputError(_describe(error, prefix), where=where) from error
    except ValueError as error:  # of what holds the sections, or digits without end
        raise InputError(str(error), where=where) from error


_SHORTER = {
    "greater than or equal to": "at least",
    "greater than": "more than",
    "less than or equal to": "at most",
}


def _describe(error: ValidationError, prefix: str) -> str:
    """The first fault on one line."""
    fault = error.errors(include_url=False)[0]
    if fault["type"] == "value_error":  # of a check between options, which names them
        return str(fault["ctx"]["error"])
    name = prefix + str(fault["loc"][0])
    what = fault["msg"].replace("Input should be", "must be")
    for words, short in _SHORTER.items():
        what = what.replace(words, short)
    return f"'{name}' {what}, got {_format(fault['input'])}"


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


def to_dict(options: Any) -> dict[str, Any]:
    """Options as plain nested dictionaries."""
    return dataclasses.asdict(options)


def iter_options(options: Any, prefix: str = "") -> Iterator[OptionInfo]:
    """All options, section by section; options of a section come before its sub-sections."""
    sections = _section_names(options)
    for name, info in declared_fields(options).items():
        if name not in sections:
            yield _describe_option(f"{prefix}{name}", getattr(options, name), info)
    for name in sections:
        yield from iter_options(getattr(options, name), f"{prefix}{name}.")


def _describe_option(name: str, value: Any, info: FieldInfo) -> OptionInfo:
    kinds = [kind for kind in typing.get_args(info.annotation) if kind is not type(None)]
    kind: Any = kinds[0] if len(kinds) == 1 else info.annotation
    is_choice = typing.get_origin(kind) is typing.Literal
    choices = typing.get_args(kind) if is_choice else ()
    word = "list" if typing.get_origin(kind) is tuple else getattr(kind, "__name__", "str")
    doc = info.description or ""
    word = ("str" if is_choice else word) + " or unset" * (info.default is None)
    return OptionInfo(name, value, info.default, word, choices, _limits(info), doc)


def _limits(info: FieldInfo) -> str:
    """The range of a number in words; what every integer has to fit into is none."""
    words = {"ge": "at least", "gt": "more than", "le": "at most", "lt": "less than"}
    bounds = {key: getattr(m, key) for m in info.metadata for key in words if hasattr(m, key)}
    if bounds.get("le") == _MAX_INTEGER:
        del bounds["le"]
    return " and ".join(f"{words[key]} {bounds[key]:.10g}" for key in words if key in bounds)


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
    return nest(
        {key.strip(): parsed["value"] if len(parsed) == 1 else _number_or_text(value.strip())}
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


def declared_fields(options: Any) -> dict[str, FieldInfo]:
    """Options of pydantic; of a plain dataclass its sections."""
    declared: dict[str, FieldInfo] = getattr(options, "__pydantic_fields__", {})
    return declared


def _section_names(options: Any) -> list[str]:
    names = [field.name for field in dataclasses.fields(options)]
    return [name for name in names if dataclasses.is_dataclass(getattr(options, name))]


def _names(options: Any) -> set[str]:
    return {*declared_fields(options), *_section_names(options)}
