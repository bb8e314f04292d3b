"""Filtered copies: their job, and those of KITTI folders and of PCD, PLY, LAS and LAZ files: points
removed, in the encoding that they have, all else as it was."""

import os
import re
import shutil
import struct
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any, NamedTuple

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


_BLOCK_BYTES = 8 << 20  # of points copied at once
_LABEL = 4  # bytes of a label of SemanticKITTI

# (file, its new copy, (n,) points to remove)
FilterFile = Callable[[Path, Path, Bool], None]


def write_kitti(job: FilterJob) -> Omissions:
    """Copy a KITTI folder with points removed, and their labels where it has SemanticKITTI's.

    Scans that were not read become empty files: numbers of scans, stamps, poses and images still
    belong together.

    Raises:
        InputError: the source has changed since it was read, or the output cannot be written.
    """

    def filter_file(path: Path, new: Path, mask: Bool) -> None:
        _copy_table(kitti.scan_layout(path), new, mask)
        labels = job.source / "labels" / f"{path.stem}.label"
        if labels.is_file() and labels.stat().st_size == _LABEL * len(mask):
            folder = new.parents[len(path.relative_to(job.source).parts) - 1] / "labels"
            values = np.frombuffer(labels.read_bytes(), f"V{_LABEL}")[~mask]
            _replace_link(folder)  # through links the source would be written
            (folder / labels.name).unlink()
            (folder / labels.name).write_bytes(values.tobytes())

    files = kitti.list_scans(job.source)
    return _write_files(job, files, filter_file, write_unread=lambda _, new: new.touch())


def write_pcd(job: FilterJob) -> Omissions:
    """Copy a PCD file or folder; points of organised clouds become NaN, others are removed."""

    def filter_file(path: Path, new: Path, mask: Bool) -> None:
        _copy_table(pcd.read_header(path)[0], new, mask, rb"(?m)^(\s*(?:WIDTH|POINTS)\s+)\d+")

    return _write_files(job, files_of(job.source, pcd.EXTENSIONS), filter_file)


def write_ply(job: FilterJob) -> Omissions:
    """Copy a PLY file or folder; vertices are removed, or become NaN where other elements, such as
    faces, may refer to them by their number."""

    def filter_file(path: Path, new: Path, mask: Bool) -> None:
        _copy_table(ply.read_layout(path), new, mask, rb"(?m)^(\s*element\s+vertex\s+)\d+")

    return _write_files(job, files_of(job.source, ply.EXTENSIONS), filter_file)


def write_las(job: FilterJob) -> Omissions:
    """Copy a LAS or LAZ file or folder without some points; version, format and records stay."""
    ending = job.output.suffix.lower()
    packed = ending == ".laz" if job.source.is_file() and ending in las.EXTENSIONS else None
    filter_file = partial(_filter_las, packed=packed)
    return _write_files(job, files_of(job.source, las.EXTENSIONS), filter_file)


def _write_files(
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


def _write_file(file: Path, new: Path, mask: Bool, filter_file: FilterFile, suffix: str) -> None:
    """Write the copy of a file; the file itself where no beam is blanked and `suffix` is its."""
    if not mask.any() and file.suffix.lower() == suffix.lower():
        copy_file(file, new)
    else:
        filter_file(file, new, mask)


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


def _replace_link(folder: Path) -> None:
    """Replace a link to a folder by a folder of links to what that holds."""
    if folder.is_symlink():
        entries = list(folder.resolve().iterdir())
        folder.unlink()
        folder.mkdir()
        for entry in entries:
            (folder / entry.name).symlink_to(entry)


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
    copy = _copy_lines if layout.text else _copy_records
    copy = _copy_columns if layout.compressed else copy
    with InputFile(layout.path) as source, new.open("wb") as target:
        header = source.read(layout.header)
        if header and not layout.ordered:
            header = re.sub(counts, rb"\g<1>%d" % np.count_nonzero(~mask), header)
        target.write(header)
        copy(source, target, layout, mask)
        shutil.copyfileobj(source, target)


def _unknown(dtype: np.dtype[Any]) -> Any:
    """The value of a coordinate that is not known."""
    return np.nan if dtype.kind == "f" else 0


def _blank_records(
    layout: TableLayout, records: NDArray[np.uint8], removed: Bool
) -> NDArray[np.uint8]:
    """Records (n, size) without those of a mask, or without their coordinates."""
    if not layout.ordered:
        return records[~removed]
    records = records.copy()
    for field, byte, _ in map(layout.find_column, "xyz"):
        value = np.array(_unknown(field.dtype), field.dtype)
        records[removed, byte : byte + value.itemsize] = np.frombuffer(value.tobytes(), np.uint8)
    return records


def _copy_records(source: IO[bytes], target: IO[bytes], layout: TableLayout, mask: Bool) -> None:
    target.write(source.read(layout.start - layout.header))
    step = max(1, _BLOCK_BYTES // layout.record)
    for first in range(0, len(mask), step):
        removed = mask[first : first + step]
        rows = np.frombuffer(source.read(len(removed) * layout.record), np.uint8)
        if len(rows) < len(removed) * layout.record:
            raise table.truncated_error(layout.path)
        target.write(_blank_records(layout, rows.reshape(len(removed), -1), removed).tobytes())


def _copy_columns(source: IO[bytes], target: IO[bytes], layout: TableLayout, mask: Bool) -> None:
    records = _blank_records(layout, np.hstack(pcd.unpack_columns(layout)), mask)
    ends = np.cumsum([field.size for field in layout.fields])[:-1]
    data = b"".join(column.tobytes() for column in np.hsplit(records, ends))
    # room for more bytes than LZF makes of any data: else it refuses what it cannot shorten
    room = len(data) + len(data) // 8 + 64
    packed = import_extra("lzf", layout.path).compress(data, room) if data else b""
    target.write(struct.pack("<II", len(packed), len(data)) + packed)
    source.seek(int.from_bytes(source.read(8)[:4], "little"), 1)


def _copy_lines(source: IO[bytes], target: IO[bytes], layout: TableLayout, mask: Bool) -> None:
    source.seek(0)
    header_lines, row = source.read(layout.header).count(b"\n"), 0
    for _ in range(layout.lines - header_lines):
        target.write(source.readline())
    columns = map(layout.find_column, "xyz")
    unknown = {value: b"%g" % _unknown(field.dtype) for field, _, value in columns}
    while row < len(mask):
        line = source.readline()
        if not line:
            raise table.truncated_error(layout.path)
        if table.is_blank(line):
            target.write(line)
            continue
        if not mask[row]:
            target.write(line)
        elif layout.ordered:
            target.write(replace_words(line, unknown))
        row += 1
