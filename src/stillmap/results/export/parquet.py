"""Export all beams of a result as a Parquet table."""

import importlib
from pathlib import Path
from typing import Any

from stillmap.core.errors import InputError, install_command
from stillmap.core.files import atomic_file
from stillmap.core.recording import Recording
from stillmap.results.folder import Exported
from stillmap.results.tables import beam_columns, beam_schema, split_scans


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

    The columns are those of `tables.beam_columns`; a row group holds about a million beams.

    Args:
        result: labels and poses.
        deskewed: its recording without the motion during scans.
        path: the file, written atomically.

    Raises:
        InputError: pyarrow is not installed, or the file cannot be written.
    """
    parquet = require_pyarrow()
    arrow = importlib.import_module("pyarrow")
    recording, schema = result.recording, beam_schema(result.poses)
    with (
        atomic_file(path) as work,
        work.open("wb") as file,  # not by name: it need not be UTF-8
        parquet.ParquetWriter(file, schema, compression="zstd") as writer,
    ):
        for scans in split_scans(recording):
            columns = beam_columns(recording, deskewed, result.poses, result.p_static, scans)
            writer.write_table(arrow.table(columns, schema=schema), row_group_size=1 << 40)
