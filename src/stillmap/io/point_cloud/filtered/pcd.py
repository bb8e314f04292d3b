"""Filtered copies of PCD files, in the encoding that they have."""

import shutil
import struct
from functools import partial
from pathlib import Path

import numpy as np

from stillmap.core.errors import import_extra
from stillmap.core.input_files import InputFile
from stillmap.io.filtered_copy import FilterJob, Mask, Omissions, require_rows, write_files
from stillmap.io.point_cloud import pcd
from stillmap.io.point_cloud.binary_table import TableLayout
from stillmap.io.point_cloud.filtered import table
from stillmap.io.point_cloud.scans import files_of
from stillmap.io.point_cloud.signatures import PCD_EXTENSIONS


def write_filtered(job: FilterJob) -> Omissions:
    """Copy a file or folder; points of organised clouds become NaN, others are removed.

    Raises:
        InputError: the source has changed since it was read, or the output cannot be written.
    """
    return write_files(job, files_of(job.source, PCD_EXTENSIONS), _filter_file)


def _filter_file(path: Path, new: Path, masks: list[Mask | None]) -> None:
    mask, head = masks[0], pcd.read_header(path)
    assert mask is not None
    removed = 0 if head.organised else int(np.count_nonzero(mask))
    edit = partial(_edit_line, count=head.layout.rows - removed) if removed else bytes
    if head.compressed:
        _write_compressed(head.layout, new, mask, edit, keep=head.organised)
    else:
        table.write_table(head.layout, new, mask, edit, keep=head.organised)


def _edit_line(line: bytes, count: int) -> bytes:
    if line.split()[:1] in ([b"WIDTH"], [b"POINTS"]):
        return table.set_count(line, 1, count)
    return line


def _write_compressed(
    layout: TableLayout, new: Path, mask: Mask, edit_line: table.EditLine, *, keep: bool
) -> None:
    """See `table.write_table`."""
    require_rows(mask, layout.rows, layout.path)
    unpacked = np.frombuffer(pcd.unpack_columns(layout), np.uint8)
    cleared = {byte: field for field, byte, _ in table.iter_coordinates(layout)} if keep else {}
    columns, byte = [], 0
    for field in layout.fields:
        start = byte * layout.rows
        column = unpacked[start : start + field.size * layout.rows].reshape(layout.rows, field.size)
        if not keep:
            column = column[~mask]
        elif byte in cleared:
            column = column.copy()
            column.view(field.dtype)[mask, 0] = table.no_coordinate(field)
        columns.append(column.tobytes())
        byte += field.size
    data = b"".join(columns)
    lzf, packed = import_extra("lzf", layout.path), b""
    if data:
        # room for more bytes than LZF makes of any data: else it refuses what it cannot shorten
        packed = lzf.compress(data, len(data) + len(data) // 8 + 64)
    with InputFile(layout.path) as source, new.open("wb") as target:
        table.write_header(source, target, layout, edit_line)
        target.write(struct.pack("<II", len(packed), len(data)) + packed)
        size = int.from_bytes(source.read(8)[:4], "little")
        source.seek(layout.header + 8 + size)
        shutil.copyfileobj(source, target)
