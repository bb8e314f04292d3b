"""Filtered copies of recordings: what their writers get and return, and copies of folders."""

import os
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import release_pages
from stillmap.core.errors import InputError
from stillmap.core.files import atomic_file, atomic_folder
from stillmap.core.input_files import copy_file
from stillmap.core.recording import Recording
from stillmap.io.text_lines import Progress
from stillmap.prepare.options import ReadOptions

Mask = NDArray[np.bool_]
# (file, its new copy, (n,) points to remove)
FilterFile = Callable[[Path, Path, Mask], None]


@dataclass(frozen=True, eq=False)
class FilterJob:
    """A recording to be written again, in its own format, with some beams blanked.

    Attributes:
        source: the file or folder that was read.
        output: the copy; it appears complete or not at all.
        recording: as it was read from `source`.
        blank: (M,) beams to blank.
        options: with which it was read.
        marker: pattern of a file that every folder of the format holds; "": unused, for files.
        overwrite: replace what is there.
        omit: folders inside `source` that are not copied.
        progress: called with the share of the copy that is written, 0 to 1.
        kind: of the bag to write, as `writers.py` names it; "": that of the source, or no bag.
    """

    source: Path
    output: Path
    recording: Recording
    blank: Mask
    options: ReadOptions
    marker: str = ""
    overwrite: bool = False
    omit: tuple[Path, ...] = ()
    progress: Progress | None = None
    kind: str = ""

    def scan_masks(self, count: int) -> list[Mask | None]:
        """(n,) beams to blank of the scan of each of `count` records; None: it was not read.

        Raises:
            InputError: `source` has other records than were read.
        """
        record = self.recording.record
        if record is None or not ((record >= 0) & (record < count)).all():
            raise other_recording_error(self.source)
        masks: list[Mask | None] = [None] * count
        for scan, number in enumerate(record.tolist()):
            masks[number] = self.blank[self.recording.beams_of(scan)]
        return masks

    def report(self, share: float) -> None:
        """Report progress, and release the pages of labels on the way."""
        release_pages(self.blank)
        if self.progress is not None:
            self.progress(share)


class Omissions(NamedTuple):
    """The parts of a recording that a filtered copy lacks.

    Attributes:
        scans: number of scans left out, since nothing is known of their beams.
        notes: on what else is left out or not filtered, a sentence each.
    """

    scans: int = 0
    notes: tuple[str, ...] = ()


def other_recording_error(path: Path) -> InputError:
    """The error for a file or folder that has changed since it was read."""
    return InputError("is not the recording that was mapped: other scans", where=str(path))


def write_files(
    job: FilterJob,
    files: Sequence[Path],
    filter_file: FilterFile,
    write_unread: Callable[[Path, Path], None] | None = None,
) -> Omissions:
    """Write a folder, or one file, with every file of a scan filtered and all others copied.

    Args:
        job: see FilterJob.
        files: those of scans, in the order of the reader.
        filter_file: writes the copy of a file.
        write_unread: writes the copy of a file that was not read; None: it is left out.
    """
    masks = job.scan_masks(len(files))
    omissions = Omissions(sum(mask is None for mask in masks))
    if job.source.is_file():
        with atomic_file(job.output) as work:
            if masks[0] is not None:
                _write_file(files[0], work, masks[0], filter_file, job.output.suffix)
        return omissions
    with atomic_folder(job.output, job.marker, job.overwrite) as folder:
        _copy_others(job.source, folder, set(files), job.omit)
        for number, (file, mask) in enumerate(zip(files, masks, strict=True)):
            new = folder / file.relative_to(job.source)
            if mask is not None:
                _write_file(file, new, mask, filter_file, file.suffix)
            elif write_unread is not None:
                write_unread(file, new)
            job.report((number + 1) / len(files))
    return omissions


def _write_file(file: Path, new: Path, mask: Mask, filter_file: FilterFile, suffix: str) -> None:
    """Write the copy of a file; the file itself where no beam is blanked and `suffix` is its."""
    try:
        if not mask.any() and file.suffix.lower() == suffix.lower():
            copy_file(file, new)
        else:
            filter_file(file, new, mask)
    except MemoryError as error:
        raise InputError("does not fit into memory", where=str(file)) from error


def _copy_others(
    source: Path, target: Path, files: Collection[Path], omit: Collection[Path]
) -> None:
    """Copy what a folder holds, but not `files` (their folders are made) nor folders `omit`.

    Symbolic links to other places stay links.
    """
    left_out = {os.path.realpath(path) for path in omit}
    folders = {parent for file in files for parent in file.parents}
    for entry in sorted(source.iterdir()):
        new = target / entry.name
        if entry in files or os.path.realpath(entry) in left_out:
            continue
        if entry.is_symlink() and entry not in folders:
            new.symlink_to(os.path.realpath(entry))
        elif entry.is_dir():
            new.mkdir()
            _copy_others(entry, new, files, omit)
        elif entry.is_file():
            copy_file(entry, new)
