"""Conversion of values to JSON."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np


def count_skipped(source: Mapping[str, Any]) -> int:
    """Count of skipped records; `skipped` is `{reason: {"count", "lines"}}`."""
    skipped: Mapping[str, Mapping[str, Any]] = source.get("skipped") or {}
    return sum(int(one["count"]) for one in skipped.values())


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
