"""Filtered copies of folders of RGB-D cameras: depth set to zero, all other files as they were."""

from functools import partial
from pathlib import Path

import numpy as np

from stillmap.core.errors import InputError
from stillmap.io import images, rgbd, rgbd_folders
from stillmap.io.filtered_copy import FilterJob, Mask, Omissions, require_rows, write_files


def check(source: Path) -> None:
    """Refuse folders whose depth images are of other kinds than PNG.

    Raises:
        InputError: there is one.
    """
    for _, file in rgbd_folders.list_frames(source).depth:
        if file.is_file() and not images.is_png(file):
            raise InputError("cannot be written again: depth images must be PNG", where=str(file))


def write_filtered(job: FilterJob) -> Omissions:
    """Copy a folder with depth set to zero.

    Where only every n-th pixel was read, the others follow the nearest one. Depth images that were
    not read become images without depth.

    Raises:
        InputError: the source has changed since it was read, or the output cannot be written.
    """
    frames = rgbd_folders.list_frames(job.source)
    files = [file for _, file in frames.depth]
    size = rgbd.first_image_size(frames.depth)
    filter_file = partial(_filter_file, step=job.options.depth_step)
    return write_files(job, files, filter_file, write_unread=partial(_write_empty, size=size))


def _filter_file(path: Path, new: Path, masks: list[Mask | None], step: int) -> None:
    mask, image = masks[0], images.read_image(path)
    assert mask is not None
    pixels = [np.arange(n) for n in image.shape[:2]]
    rows, columns = (len(of_axis[::step]) for of_axis in pixels)
    require_rows(mask, rows * columns, path)
    nearest = np.ix_(
        *(
            np.minimum((of_axis + step // 2) // step, count - 1)
            for of_axis, count in zip(pixels, (rows, columns), strict=True)
        )
    )
    blank = mask.reshape(rows, columns)[nearest] & rgbd.is_depth(image)
    new.write_bytes(images.rewrite_png(path, np.where(blank, np.uint16(0), image)))


def _write_empty(path: Path, new: Path, size: tuple[int, int] | None) -> None:
    if size is not None and path.exists():
        width, height = size
        images.write_png(np.zeros((height, width), np.uint16), new)
