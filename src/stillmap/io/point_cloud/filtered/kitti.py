"""Filtered copies of KITTI folders."""

from functools import partial
from pathlib import Path

import numpy as np

from stillmap.core.input_files import read_bytes
from stillmap.io.filtered_copy import FilterJob, Mask, Omissions, require_rows, write_files
from stillmap.io.point_cloud import kitti

_LABELS, _LABEL = Path("labels"), 4  # folder of labels of points, bytes of one


def write_filtered(job: FilterJob) -> Omissions:
    """Copy a folder with points removed, and with their labels where it has those of SemanticKITTI.

    Scans that were not read become empty files: numbers of scans, stamps, poses and images still
    belong together.

    Raises:
        InputError: the source has changed since it was read, or the output cannot be written.
    """
    files = kitti.list_scans(job.source)
    filter_file = partial(_filter_file, source=job.source)
    return write_files(job, files, filter_file, write_unread=lambda _, new: new.touch())


def _filter_file(path: Path, new: Path, masks: list[Mask | None], source: Path) -> None:
    mask = masks[0]
    assert mask is not None
    _copy_rows(path, new, mask, kitti.RECORD)
    labels = _LABELS / f"{path.stem}.label"
    if (source / labels).is_file() and (source / labels).stat().st_size == _LABEL * len(mask):
        target = new.parents[len(path.relative_to(source).parts) - 1]
        _copy_rows(source / labels, target / labels, mask, _LABEL)


def _copy_rows(path: Path, new: Path, mask: Mask, size: int) -> None:
    """Copy a file of rows of `size` bytes without those of a mask."""
    rows = np.frombuffer(read_bytes(path, kitti.MAX_SCAN), np.uint8)
    require_rows(mask, len(rows) // size, path)
    new.write_bytes(rows.reshape(-1, size)[~mask].data)
