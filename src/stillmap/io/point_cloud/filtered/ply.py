"""Filtered copies of PLY files, in the encoding that they have."""

from functools import partial
from pathlib import Path

import numpy as np

from stillmap.io.filtered_copy import FilterJob, Mask, Omissions, write_files
from stillmap.io.point_cloud import ply
from stillmap.io.point_cloud.filtered import table
from stillmap.io.point_cloud.scans import files_of
from stillmap.io.point_cloud.signatures import PLY_EXTENSIONS


def write_filtered(job: FilterJob) -> Omissions:
    """Copy a file or folder; vertices are removed, or become NaN where other elements, such as
    faces, may refer to them by their number.

    Raises:
        InputError: the source has changed since it was read, or the output cannot be written.
    """
    return write_files(job, files_of(job.source, PLY_EXTENSIONS), _filter_file)


def _filter_file(path: Path, new: Path, masks: list[Mask | None]) -> None:
    mask, head = masks[0], ply.read_header(path)
    assert mask is not None
    count = head.layout.rows - int(np.count_nonzero(mask))
    edit = bytes if head.indexed else partial(_edit_line, count=count)
    table.write_table(head.layout, new, mask, edit, keep=head.indexed)


def _edit_line(line: bytes, count: int) -> bytes:
    return table.set_count(line, 2, count) if line.split()[:2] == [b"element", b"vertex"] else line
