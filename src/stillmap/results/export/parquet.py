"""Export all beams of a result as a Parquet table."""

import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.errors import InputError
from stillmap.core.extras import install_command
from stillmap.core.files import atomic_file
from stillmap.core.recording import Recording
from stillmap.results.folder import Exported

_ROW_GROUP = 1 << 20  # rows, approximately


def require_pyarrow() -> Any:
    """Import pyarrow.parquet.

    Raises:
        InputError: pyarrow is not installed.
    """
    try:
        return importlib.import_module("pyarrow.parquet")
    except ImportError as error:
        hint = install_command("io")
        raise InputError("Parquet needs the package pyarrow", hint=hint) from error


def write(result: Exported, deskewed: Recording, path: Path) -> None:
    """Write a row per beam, in the order of the recording.

    Columns: `scan` (int32, from 0), `stamp_ns` (int64), `beam` (int32, index in the scan), `x`, `y`
    (float32, end point in m in the map frame), `range` (float32, m), `hit` (bool), `p_static`
    (float32). Unusable beams are NaN.

    Args:
        result: labels and poses.
        deskewed: its recording without the motion during scans.
        path: the file, written atomically.

    Raises:
        InputError: pyarrow is not installed, or the file cannot be written.
    """
    parquet = require_pyarrow()
    arrow = importlib.import_module("pyarrow")
    kinds = {
        "scan": arrow.int32(),
        "stamp_ns": arrow.int64(),
        "beam": arrow.int32(),
        "x": arrow.float32(),
        "y": arrow.float32(),
        "range": arrow.float32(),
        "hit": arrow.bool_(),
        "p_static": arrow.float32(),
    }
    schema = arrow.schema([arrow.field(name, kind, nullable=False) for name, kind in kinds.items()])
    with (
        atomic_file(path) as work,
        parquet.ParquetWriter(str(work), schema, compression="zstd") as writer,
    ):
        for scans in _row_groups(result.recording):
            columns = _columns(result, deskewed, scans)
            writer.write_table(arrow.table(columns, schema=schema), row_group_size=1 << 40)


def _row_groups(recording: Recording) -> Iterator[slice]:
    """Ranges of scans for the row groups, at least one scan each."""
    first, T = 0, recording.n_scans
    while first < T:
        end = (
            int(np.searchsorted(recording.offset, recording.offset[first] + _ROW_GROUP, "right"))
            - 1
        )
        end = min(max(end, first + 1), T)
        yield slice(first, end)
        first = end


def _columns(result: Exported, deskewed: Recording, scans: slice) -> dict[str, NDArray[Any]]:
    recording = result.recording
    offset = recording.offset[scans.start : scans.stop + 1]
    beams = slice(int(offset[0]), int(offset[-1]))
    scan = np.repeat(np.arange(scans.start, scans.stop, dtype=np.int32), np.diff(offset))
    number = np.arange(beams.start, beams.stop)
    ends = deskewed.end_points(number, result.poses).astype(np.float32)
    x, y = recording.points[beams].astype(np.float64).T
    return {
        "scan": scan,
        "stamp_ns": recording.stamp_ns[scan],
        "beam": (number - recording.offset[scan]).astype(np.int32),
        "x": np.ascontiguousarray(ends[:, 0]),
        "y": np.ascontiguousarray(ends[:, 1]),
        "range": np.hypot(x, y).astype(np.float32),
        "hit": np.asarray(recording.hit[beams]),
        "p_static": np.asarray(result.p_static[beams]),
    }
