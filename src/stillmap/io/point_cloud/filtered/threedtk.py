"""Filtered copies of 3DTK scans."""

from functools import partial
from pathlib import Path

import numpy as np

from stillmap.core.files import atomic_file, require_new_file
from stillmap.core.input_files import copy_content
from stillmap.io.filtered_copy import FilterJob, Mask, Omissions, require_rows, write_files
from stillmap.io.point_cloud import threedtk
from stillmap.io.point_cloud.binary_table import is_blank
from stillmap.io.point_cloud.filtered.table import set_count
from stillmap.io.point_cloud.scans import files_of
from stillmap.io.point_cloud.signatures import THREEDTK_EXTENSIONS
from stillmap.io.text_lines import is_gzip, open_new_text, read_lines


def write_filtered(job: FilterJob) -> Omissions:
    """Copy a folder, or a file and its pose, with points removed; gzip where the source is, a file
    by its name.

    Raises:
        InputError: the source has changed since it was read, or the output cannot be written.
    """
    files = files_of(job.source, THREEDTK_EXTENSIONS)
    if job.source.is_dir():
        return write_files(job, files, _filter_file)
    compressed = job.output.name.lower().endswith(".gz")
    filter_file = partial(_filter_file, compressed=compressed)
    pose, new_pose = threedtk.pose_file(job.source), threedtk.pose_file(job.output)
    if not pose.is_file():
        return write_files(job, files, filter_file)
    require_new_file(new_pose, job.overwrite)
    with atomic_file(new_pose) as work:
        copy_content(pose, work)
        return write_files(job, files, filter_file)


def _filter_file(
    path: Path, new: Path, masks: list[Mask | None], compressed: bool | None = None
) -> None:
    mask = masks[0]
    assert mask is not None
    kept = len(mask) - int(np.count_nonzero(mask))
    row, started = 0, False
    with open_new_text(new, is_gzip(path) if compressed is None else compressed) as target:
        for line in read_lines(path):
            text = line.text
            if not is_blank(text):
                if started or threedtk.is_point(text):
                    require_rows(mask[: row + 1], row + 1, path)
                    text = b"" if mask[row] else text
                    row += 1
                elif text.split() == [str(len(mask)).encode("ascii")]:
                    text = set_count(text, 0, kept)  # the heading is the count of points
                started = True
            target.write(text)
    require_rows(mask, row, path)
