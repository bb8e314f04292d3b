"""Filtered copies of KITTI folders."""

from pathlib import Path

import numpy as np

from stillmap.io.filtered_copy import FilterJob, Mask, Omissions, require_rows, write_files
from stillmap.io.point_cloud import kitti


def write_filtered(job: FilterJob) -> Omissions:
    """Copy a folder with points removed.

    Scans that were not read become empty files: numbers of scans, stamps, poses and images still
    belong together.

    Raises:
        InputError: the source has changed since it was read, or the output cannot be written.
    """
    files = kitti.list_scans(job.source)
    return write_files(job, files, _filter_file, write_unread=lambda _, new: new.touch())


def _filter_file(path: Path, new: Path, masks: list[Mask | None]) -> None:
    mask, size = masks[0], kitti.RECORD
    assert mask is not None
    rows = np.fromfile(path, np.uint8)
    require_rows(mask, len(rows) // size, path)
    rows.reshape(-1, size)[~mask].tofile(new)
