"""Conversion of values to JSON, and the package version."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np


def version() -> str:
    """The version of stillmap that runs."""
    # the package is still being imported when this module is
    from stillmap import __version__

    return __version__


def count_skipped(source: Mapping[str, Any]) -> int:
    """How many records the reader left out; `skipped` is `{reason: {"count", "lines"}}`."""
    skipped: Mapping[str, Mapping[str, Any]] = source.get("skipped") or {}
    return sum(int(one["count"]) for one in skipped.values())


def to_jsonable(value: Any) -> Any:
    """`value` in JSON's own types: arrays as lists, paths as text, NaN and infinity as None."""
    if isinstance(value, Mapping):
        return {str(key): to_jsonable(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return to_jsonable(value.tolist())
    if isinstance(value, list | tuple):
        return [to_jsonable(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)
