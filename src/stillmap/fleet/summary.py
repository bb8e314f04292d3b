"""Summary of a result for the page of a fleet: a small map, figures and warnings."""

import json
from pathlib import Path
from typing import Any, TypedDict

from stillmap.core.advice import split_advice
from stillmap.core.errors import InputError
from stillmap.core.input_files import read_text
from stillmap.core.schema import prune
from stillmap.results.reader import read_grid
from stillmap.results.report.figures import data_uri, draw_map, map_window
from stillmap.results.run_record import read_record

_PIXELS = 90_000  # of a small map, at most
_GREYS = 16  # so that it takes a few kB
_MAX_SESSIONS = 64 << 20  # bytes of a sessions.json


class _Noted(TypedDict, total=False):
    """Fields of a `run.json` that the fleet page shows."""

    counts: dict[str, int]
    area: dict[str, float]
    quality: dict[str, float | None]
    changes: list[Any]
    warnings: list[str]


def summarize_result(folder: Path) -> dict[str, Any]:
    """The JSON-able summary of a result folder or a place.

    Raises:
        InputError: a file of it is damaged.
    """
    record = prune(read_record(folder), _Noted)
    warnings = [split_advice(text) for text in record.get("warnings", ())]
    return {
        "counts": record.get("counts", {}),
        "area": record.get("area", {}),
        "quality": record.get("quality", {}),
        "changes": len(record.get("changes", ())),
        "warnings": [what for what, todo in warnings if todo],
        "notes": [what for what, todo in warnings if not todo],
        "map": _draw_small(folder),
    }


def summarize_sessions(place: Path) -> list[dict[str, Any]]:
    """Name, acceptance and reason of every session of a place, from its `sessions.json`.

    Raises:
        InputError: it is damaged.
    """
    path = place / "sessions.json"
    try:
        found = json.loads(read_text(path, _MAX_SESSIONS))
        return [
            {
                "name": str(one["name"]),
                "accepted": bool(one["accepted"]),
                "why": str(one.get("why") or ""),
            }
            for one in found
        ]
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise InputError(f"is damaged: {error!r}", where=str(path)) from error


def _draw_small(folder: Path) -> str | None:
    """The map as a `data:` URI; None for a map without cells."""
    grid = read_grid(folder)
    if not grid.p_occupied.size:
        return None
    picture = draw_map(grid, map_window([grid]), _PIXELS).convert("L")
    return data_uri(picture.quantize(_GREYS), optimize=True)
