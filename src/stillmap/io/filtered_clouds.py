"""Filtered copies: their job, and those of KITTI folders and of PCD, PLY, LAS and LAZ files: points
removed, in the encoding that they have, all else as it was."""

import os
import re
import shutil
import struct
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_types import Bool
from stillmap.core.arrays import release_pages
from stillmap.core.errors import InputError, import_extra
from stillmap.core.files import atomic_file, atomic_folder
from stillmap.core.input_files import InputFile, copy_file
from stillmap.core.recording import Recording
from stillmap.io.point_cloud import kitti, las, pcd, ply, table
from stillmap.io.point_cloud.clouds import files_of
from stillmap.io.point_cloud.table import TableLayout
from stillmap.io.text_lines import Progress, replace_words
from stillmap.prepare.options import ReadOptions


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
    blank: Bool
    options: ReadOptions
    marker: str = ""
    overwrite: bool = False
    omit: tuple[Path, ...] = ()
    progress: Progress | None = None
    kind: str = ""

    def scan_masks(self, count: int) -> list[Bool | None]:
        """(n,) beams to blank of the scan of each of `count` records; None: it was not read.

        Raises:
            InputError: `source` has other records than were read.
        """
        record = self.recording.record
        if record is None or not ((record >= 0) & (record < count)).all():
            raise other_recording_error(self.source)
        masks: list[Bool | None] = [None] * count
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


# (file, its new copy, (n,) points to remove)
FilterFile = Callable[[Path, Path, Bool], None]

_LABEL = np.dtype("V4")  # of SemanticKITTI


def write_kitti(job: FilterJob) -> Omissions:
    """Copy a KITTI folder with points removed, and their labels where it has SemanticKITTI's.

    Scans that were not read become empty files: numbers of scans, stamps, poses and images still
    belong together.

    Raises:
        InputError: the source has changed since it was read, or the output cannot be written.
    """
    scans = kitti.list_scans(job.source)
    labels = [job.source / "labels" / f"{scan.stem}.label" for scan in scans]

    def filter_file(path: Path, new: Path, mask: Bool) -> None:
        if path.suffix == ".label" and path.stat().st_size != _LABEL.itemsize * len(mask):
            copy_file(path, new)
        elif path.suffix == ".label":
            new.write_bytes(np.frombuffer(path.read_bytes(), _LABEL)[~mask].tobytes())
        elif len(mask):
            _copy_table(kitti.scan_layout(path), new, mask)
        else:
            new.touch()

    masks, unread = job.scan_masks(len(scans)), np.zeros(0, np.bool_)
    known = [unread if mask is None else mask for mask in masks] * 2
    files = zip([*scans, *labels], known, strict=True)
    _write_folder(job, {file: mask for file, mask in files if file.is_file()}, filter_file)
    return Omissions(sum(mask is None for mask in masks))


def filter_pcd(path: Path, new: Path, mask: Bool) -> None:
    """Copy a PCD file; points of organised clouds become NaN, others are removed."""
    _copy_table(pcd.read_header(path)[0], new, mask, rb"(?m)^(\s*(?:WIDTH|POINTS)\s+)\d+")


def filter_ply(path: Path, new: Path, mask: Bool) -> None:
    """Copy a PLY file; vertices are removed, or become NaN where other elements, such as faces, may
    refer to them by their number."""
    _copy_table(ply.read_layout(path), new, mask, rb"(?m)^(\s*element\s+vertex\s+)\d+")


def write_las(job: FilterJob) -> Omissions:
    """Copy a LAS or LAZ file or folder without some points; version, format and records stay."""
    ending = job.output.suffix.lower()
    packed = ending == ".laz" if job.source.is_file() and ending in las.EXTENSIONS else None
    return write_files(partial(_filter_las, packed=packed), las.EXTENSIONS, job)


def write_files(filter_file: FilterFile, extensions: tuple[str, ...], job: FilterJob) -> Omissions:
    """Copy the one file, or the folder, of a recording; files that were not read are left out."""
    files = files_of(job.source, extensions)
    masks = dict(zip(files, job.scan_masks(len(files)), strict=True))
    if not job.source.is_file():
        _write_folder(job, masks, filter_file)
        return Omissions(sum(mask is None for mask in masks.values()))
    with atomic_file(job.output) as work:
        filter_file(job.source, work, job.blank)
    return Omissions()


def _write_folder(
    job: FilterJob, masks: Mapping[Path, Bool | None], filter_file: FilterFile
) -> None:
    """Write a folder with the files that have masks filtered, without those that have none, and
    with all others copied."""
    with atomic_folder(job.output, job.marker, job.overwrite) as folder:
        _copy_others(job.source, folder, masks.keys(), job.omit)
        for number, (file, mask) in enumerate(masks.items(), start=1):
            if mask is not None:
                filter_file(file, folder / file.relative_to(job.source), mask)
            job.report(number / len(masks))


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


def _filter_las(path: Path, new: Path, mask: Bool, packed: bool | None) -> None:
    laspy = import_extra("laspy", path)
    with las.open_las_reader(path) as reader:
        header, first = reader.header, 0
        if any(vlr.user_id == "copc" for vlr in header.vlrs):
            raise InputError("is a COPC file, an index of points by place", where=str(path))
        if header.point_count != len(mask):
            raise other_recording_error(path)
        packed = header.are_points_compressed if packed is None else packed
        with las.open_las_writer(new, laspy, header, packed) as writer:
            for block in las.iter_blocks(reader, path):
                writer.write_points(block[~mask[first : first + len(block)]])
                first += len(block)
            if first < len(mask):
                raise table.truncated_error(path)
            if header.number_of_evlrs:
                reader.read_evlrs()
                writer.write_evlrs(reader.evlrs)


def _copy_table(layout: TableLayout, new: Path, mask: Bool, counts: bytes = b"()") -> None:
    """Copy a file without the points of a mask; where they are ordered, they stay without
    coordinates: NaN, or 0 in columns of integers.

    Args:
        layout: of the file.
        new: its copy.
        mask: (n,) points to remove.
        counts: pattern of the lines of the header with the number of points after group 1.

    Raises:
        InputError: the file has another number of points, or is damaged.
    """
    if layout.rows != len(mask):
        raise other_recording_error(layout.path)
    with InputFile(layout.path) as source, new.open("wb") as target:
        header = source.read(layout.header)
        lines = layout.lines - header.count(b"\n")
        if header and not layout.ordered:
            header = re.sub(counts, rb"\g<1>%d" % np.count_nonzero(~mask), header)
        target.write(header)
        if layout.text:
            target.writelines(source.readline() for _ in range(lines))
            _copy_lines(source, target, layout, mask)
        else:
            target.write(source.read(layout.start - layout.header))
            _copy_records(source, target, layout, mask)
        shutil.copyfileobj(source, target)


def _copy_records(source: IO[bytes], target: IO[bytes], layout: TableLayout, mask: Bool) -> None:
    first = 0
    for records in table.iter_records(layout):
        removed = mask[first : first + len(records)]
        first += len(records)
        if not layout.ordered:
            records = records[~removed]
        else:
            records = records.copy()
            table.erase_coordinates(records, removed)
        target.write(_pack(records, layout.path) if layout.compressed else records.tobytes())
    packed_size = int.from_bytes(source.read(8)[:4], "little") if layout.compressed else 0
    source.seek(packed_size or layout.rows * layout.dtype.itemsize, os.SEEK_CUR)


def _pack(records: NDArray[np.void], path: Path) -> bytes:
    data = b"".join(records[name].tobytes() for name in records.dtype.names or ())
    # room for more bytes than LZF makes of any data: else it refuses what it cannot shorten
    room = len(data) + len(data) // 8 + 64
    packed = import_extra("lzf", path).compress(data, room) if data else b""
    return struct.pack("<II", len(packed), len(data)) + packed


def _copy_lines(source: IO[bytes], target: IO[bytes], layout: TableLayout, mask: Bool) -> None:
    values = {axis: table.unknown_value(layout.dtype[axis]) for axis in "xyz"}
    unknown = {layout.count_values(axis): b"%g" % value for axis, value in values.items()}
    row = 0
    while row < len(mask):
        line = source.readline()
        if not line:
            raise table.truncated_error(layout.path)
        is_point = not table.is_blank(line)
        if not (is_point and mask[row]):
            target.write(line)
        elif layout.ordered:
            target.write(replace_words(line, unknown))
        row += is_point
