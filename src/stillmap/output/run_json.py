"""`run.json`: what was run, on what, with which options, and how it went."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from stillmap.options import to_dict
from stillmap.output.known import known_area
from stillmap.output.points import beam_counts
from stillmap.output.protocols import ChangeLike, IterationRecordLike, LoopLike, ResultLike

FORMAT_VERSION = 1
_MILLIMETRES = 3  # digits


def run_record(result: ResultLike, more: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """The content of `run.json` as JSON-able values; numbers that are not finite become None.

    `more` are further keys with what they hold.
    """
    counts = beam_counts(result.recording, result.p_static)
    counts = {
        "scans": result.recording.n_scans,
        **{name: counts[name] for name in ("beams", "hits", "max_range", "unusable")},
        "skipped": skipped_count(result.recording.source),
    }
    record = {
        "format_version": FORMAT_VERSION,
        "version": version(),
        "input": result.recording.source,
        "options": to_dict(result.options),
        "iterations": [_iteration(it) for it in result.iterations],
        "converged": result.converged,
        "best_iteration": result.best_iteration,
        **{
            key: {name: stage.get(key) for name, stage in result.stages.items()}
            for key in ("seconds", "cpu_seconds", "peak_memory_bytes")
        },
        "counts": counts,
        "area": known_area(result),
        "warnings": list(result.warnings),
        "learned": result.learned,
        "doubts": {
            "odometry_disagrees": result.doubts.disagreeing,
            "found_by_wider_search": result.doubts.widened,
            "carried_before": result.doubts.breaks,
            "beside_the_map_from": result.doubts.apart,
        },
        "changes": [_change(one) for one in result.changes],
        "loops": {
            "accepted": [_loop(one) for one in result.loops if not one.refused],
            "refused": [_loop(one) | {"why": one.refused} for one in result.loops if one.refused],
        },
        **(more or {}),
    }
    plain: dict[str, Any] = jsonable(record)
    return plain


RECORD = "run.json"  # every result has it


def write_run_json(path: Path, result: ResultLike, more: Mapping[str, Any] | None = None) -> None:
    """Write `run_record` to `path`."""
    text = json.dumps(run_record(result, more), indent=2, ensure_ascii=False, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")


def version() -> str:
    """The version of stillmap that runs."""
    # the package is still being imported when this module is
    from stillmap import __version__

    return __version__


def skipped_count(source: Mapping[str, Any]) -> int:
    """How many records the reader left out; `skipped` is `{reason: {"count", "lines"}}`."""
    skipped: Mapping[str, Mapping[str, Any]] = source.get("skipped") or {}
    return sum(int(one["count"]) for one in skipped.values())


def jsonable(value: Any) -> Any:
    """`value` in JSON's own types: arrays as lists, paths as text, NaN and infinity as None."""
    if isinstance(value, Mapping):
        return {str(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return jsonable(value.tolist())
    if isinstance(value, list | tuple):
        return [jsonable(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)


def _loop(one: LoopLike) -> dict[str, Any]:
    return {"earlier": one.earlier, "later": one.later, "explained": one.explained}


def _change(one: ChangeLike) -> dict[str, Any]:
    return {
        "kind": one.kind,
        "x": round(one.x, _MILLIMETRES),
        "y": round(one.y, _MILLIMETRES),
        **({} if one.z is None else {"z": round(one.z, _MILLIMETRES)}),
        "size": [round(metres, _MILLIMETRES) for metres in one.size],
        "cells": len(one.cells),
        "before_ns": one.before_ns,
        "stamp_ns": one.stamp_ns,
        "last_ns": one.last_ns,
        "times": one.times,
    }


def _iteration(it: IterationRecordLike) -> dict[str, Any]:
    return {
        "number": it.number,
        "bound": it.bound,
        "expected_log_likelihood": it.expected_log_likelihood,
        "held_out_log_likelihood": it.held_out_log_likelihood,
        "changed_share": it.changed_share,
        "seconds": it.seconds,
    }
