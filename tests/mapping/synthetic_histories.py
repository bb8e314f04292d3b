"""Courses of cells made up by hand, and recordings that only know when they were made."""

from collections.abc import Sequence
from contextlib import nullcontext
from typing import Any
from unittest import mock

import numpy as np
from recordings import of_one_sensor

from stillmap import em
from stillmap.core.recording import Recording
from stillmap.mapping import Change, change_detection, detect_changes

RESOLUTION = 0.1
S = 10**9
NEVER = (-1, -1)
_CONSTANTS = {"near": "_LINK_DISTANCE", "together": "_MAX_TIME_GAP", "least": "_MIN_CELLS"}
Between = tuple[int, int]


def block(x: int, y: int, width: int, height: int) -> Any:
    """(width * height, 2) cells from x, y on."""
    columns, rows = np.meshgrid(np.arange(x, x + width), np.arange(y, y + height))
    return np.column_stack([columns.ravel(), rows.ravel()]).astype(np.int64)


def course(
    cells: Any,
    there: bool,
    *between: Between,
    count: int | None = None,
    p: float = 0.9,
    share: float = 0.5,
    static: float = 0.05,
) -> em.CellHistories:
    """All cells alike: what is there at last, and looks before and after the changes."""
    n = len(cells)
    ends = [between[0], between[-1]] if between else [NEVER, NEVER]
    return em.CellHistories(
        cells=np.asarray(cells, np.int64),
        p_static=np.full(n, static, np.float32),
        p_view_dependent=np.zeros(n, np.float32),
        p_changing=np.full(n, p, np.float32),
        p_object=np.full(n, 0.97 if there else 0.02, np.float32),
        occupied_share=np.full(n, share, np.float32),
        n_changes=np.full(n, len(between) if count is None else count, np.int32),
        change_bins=np.tile(np.array(ends, np.int32), (n, 1, 1)),
        p_in_cell=np.ones(n, np.float32),
        changing_weight=0.1,
        surfel_map=None,
    )


def together(*parts: em.CellHistories) -> em.CellHistories:
    """One after the other."""
    return em.CellHistories(
        **{
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in em.CellHistories.__dataclass_fields__
            if name not in ("changing_weight", "surfel_map")
        },
        changing_weight=0.1,
        surfel_map=None,
    )


def recording(stamps: Sequence[float], beams: int = 0) -> Recording:
    """Scans at these seconds, of so many beams each that met nothing."""
    T = len(stamps)
    return of_one_sensor(
        np.round(np.array(stamps) * S).astype(np.int64) + 5 * S,
        np.arange(T + 1, dtype=np.int64) * beams,
        np.full((T * beams, 2), 9.0, np.float32),
        np.zeros(T * beams, bool),
    )


EVERY_SECOND = recording(range(100))


def found(
    *parts: em.CellHistories, seen: Recording = EVERY_SECOND, look: float = 1.0, **options: Any
) -> list[Change]:
    """The changed places, by default with a time bin per second; `options` name constants."""
    constants = {_CONSTANTS[name]: value for name, value in options.items()}
    # patch.multiple refuses to patch nothing
    patched = mock.patch.multiple(change_detection, **constants) if constants else nullcontext()
    with patched:
        return detect_changes(together(*parts), seen, RESOLUTION, look)


def seconds(change: Change) -> tuple[float, float, float]:
    """Before, after the first and after the last change, since the recording began."""
    begin = 5 * S
    before, stamp, last = change.before_ns, change.stamp_ns, change.last_ns
    return (before - begin) / S, (stamp - begin) / S, (last - begin) / S
