"""Reading of JSON files, and conversion of values to JSON."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from stillmap.core.errors import InputError
from stillmap.core.files import to_encodable, write_text
from stillmap.core.input_files import read_text


def read_json(path: Path, max_bytes: int, hint: str = "") -> Any:
    """The content of a JSON file of at most `max_bytes` bytes; no NaN, infinity or NUL in texts.

    Raises:
        InputError: it cannot be read, is larger, or no JSON; with the hint.
    """
    try:
        text = read_text(path, max_bytes)
        content = json.loads(text, parse_constant=_reject_constant)
        if "\\u0000" in text:  # which no path, topic or name can hold
            raise ValueError("a text holds NUL")
        return content
    except InputError as error:
        raise InputError(error.what, where=error.where, hint=hint) from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"is not JSON: {error}", where=str(path), hint=hint) from error


def _reject_constant(text: str) -> NoReturn:
    raise ValueError(f"{text} is no number of JSON")


def to_jsonable(value: Any) -> Any:
    """Convert to types of JSON: arrays to lists, paths to text, NaN and infinity to None."""
    if isinstance(value, Mapping):
        return {str(key): to_jsonable(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return to_jsonable(value.tolist())
    if isinstance(value, list | tuple):
        return [to_jsonable(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)


def to_json(value: Any, indent: int | None = None) -> str:
    """JSON text of a value, which can be encoded as UTF-8 whatever file names it holds.

    Bytes of a name that are no UTF-8 are lone surrogates in Python; here they become the escapes of
    JSON, which `json.loads` turns back.

    Args:
        value: see `to_jsonable`.
        indent: spaces per level; None: one line.
    """
    text = json.dumps(to_jsonable(value), indent=indent, ensure_ascii=False, allow_nan=False)
    return to_encodable(text)


def write_json(path: Path, value: Any, indent: int | None = 1) -> None:
    """Write a value as a file of JSON; see `to_json`."""
    write_text(path, f"{to_json(value, indent)}\n")
