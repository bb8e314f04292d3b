"""Filtered copies of LAS and LAZ files: all bytes but those of points and counts stay.

Points are read by laspy and packed by lazrs. Offsets are those of the header of LAS 1.4, which
begins as those before it.
"""

import shutil
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.errors import InputError, import_extra
from stillmap.core.input_files import InputFile
from stillmap.io.filtered_copy import FilterJob, Mask, Omissions, require_rows, write_files
from stillmap.io.point_cloud import las
from stillmap.io.point_cloud.scans import files_of
from stillmap.io.point_cloud.signatures import LAS_EXTENSIONS

_VERSION, _POINTS = 25, 96  # minor version; offset of the points
_COUNT, _BOUNDS = 107, 179  # legacy counts of points and returns; greatest and least x, y, z
_WAVEFORMS, _EVLRS = 227, 235  # offsets of waveforms and of extended records, since 1.3 and 1.4
_COUNT_64 = 247  # of points and returns since 1.4


class _Statistics:
    """Counts and bounds of the points that are kept, and counts of the others."""

    def __init__(self) -> None:
        self.removed = 0
        self.removed_by_return = np.zeros(16, np.int64)
        self.low, self.high = np.full(3, np.inf), np.full(3, -np.inf)

    def add(self, points: Any, removed: Mask) -> None:
        self.removed += int(np.count_nonzero(removed))
        returns = np.asarray(points.return_number)[removed]
        self.removed_by_return += np.bincount(returns, minlength=16)[:16]
        if not removed.all():
            xyz = np.stack([np.asarray(points[axis])[~removed] for axis in "XYZ"])
            self.low = np.minimum(self.low, xyz.min(axis=1))
            self.high = np.maximum(self.high, xyz.max(axis=1))


class _Sections(NamedTuple):
    """Byte offsets of the points of a file, and of what follows them."""

    points: int
    tail: int


def write_filtered(job: FilterJob) -> Omissions:
    """Copy a file or folder with points removed.

    Raises:
        InputError: the source has changed since it was read, the output cannot be written, or
            laspy is missing.
    """
    return write_files(job, files_of(job.source, LAS_EXTENSIONS), _filter_file)


def _filter_file(path: Path, new: Path, masks: list[Mask | None]) -> None:
    mask, statistics = masks[0], _Statistics()
    assert mask is not None
    with las.open_las_reader(path) as reader, InputFile(path) as source, new.open("w+b") as target:
        require_rows(mask, reader.header.point_count, path)
        sections = _find_sections(reader, path)
        target.write(source.read(sections.points))
        records = _iter_kept(las.iter_blocks(reader, path), mask, statistics)
        if reader.header.are_points_compressed:
            _pack(records, reader, target, path)
        else:
            for rows in records:
                target.write(rows.tobytes())
        source.seek(sections.tail)
        moved = target.tell() - sections.tail
        shutil.copyfileobj(source, target)
        _update_header(target, statistics, reader.header, sections, moved)


def _find_sections(reader: Any, path: Path) -> _Sections:
    """The offsets of the points and of other data behind them.

    Raises:
        InputError: records of the file refer to places in it.
    """
    header = reader.header
    if any(vlr.user_id == "copc" for vlr in header.vlrs):
        hint = "`pdal translate` writes the points of a COPC file as a plain LAZ file"
        raise InputError("is a COPC file, an index of points by place", where=str(path), hint=hint)
    start = int(header.offset_to_point_data)
    if not header.are_points_compressed:
        return _Sections(start, start + header.point_count * header.point_format.size)
    behind = [header.start_of_waveform_data_packet_record] if header.version.minor >= 3 else []
    if header.number_of_evlrs:
        behind.append(header.start_of_first_evlr)
    size = path.stat().st_size
    return _Sections(start, min((at for at in behind if at > start), default=size))


def _iter_kept(
    blocks: Iterator[Any], mask: Mask, statistics: _Statistics
) -> Iterator[NDArray[np.uint8]]:
    """The records of points outside the mask, (n * size,) bytes of each block."""
    first = 0
    for block in blocks:
        removed = mask[first : first + len(block)]
        first += len(block)
        statistics.add(block, removed)
        yield block.array[~removed].view(np.uint8)


def _pack(records: Iterator[NDArray[np.uint8]], reader: Any, target: IO[bytes], path: Path) -> None:
    """Compress records into a file."""
    lazrs = import_extra("lazrs", path)
    vlrs = reader.header.vlrs
    vlr = lazrs.LazVlr(vlrs[vlrs.index("LasZipVlr")].record_data)
    compressor = lazrs.LasZipCompressor(target, vlr)
    try:
        for rows in records:
            compressor.compress_many(rows)
            if vlr.uses_variable_size_chunks():
                compressor.finish_current_chunk()
        compressor.done()
    except InputError:
        raise
    except Exception as error:
        target.flush()  # raises the error of a full disk, which lazrs replaces by its own
        raise InputError(f"cannot be compressed: {error}", where=str(path)) from error


def _update_header(
    file: IO[bytes], statistics: _Statistics, header: Any, sections: _Sections, moved: int
) -> None:
    """Set counts, bounds, and offsets of what follows the points."""
    if not statistics.removed:
        return
    by_return = statistics.removed_by_return[1:]
    _subtract(file, _COUNT, "<6I", [statistics.removed, *by_return[:5].tolist()])
    low, high = (
        values * header.scales + header.offsets for values in (statistics.low, statistics.high)
    )
    if np.isfinite(low).all():
        _write_at(file, _BOUNDS, struct.pack("<6d", *np.stack([high, low], axis=1).ravel()))
    if header.version.minor >= 3:
        _move(file, _WAVEFORMS, sections.tail, moved)
    if header.version.minor >= 4:
        _move(file, _EVLRS, sections.tail, moved)
        _subtract(file, _COUNT_64, "<16Q", [statistics.removed, *by_return.tolist()])


def _subtract(file: IO[bytes], at: int, layout: str, numbers: list[int]) -> None:
    """Subtract from counts; those that were not filled in stay zero."""
    file.seek(at)
    before = struct.unpack(layout, file.read(struct.calcsize(layout)))
    after = (max(old - n, 0) for old, n in zip(before, numbers, strict=True))
    _write_at(file, at, struct.pack(layout, *after))


def _move(file: IO[bytes], at: int, from_offset: int, moved: int) -> None:
    """Add to an offset in the header that leads to `from_offset` or behind it."""
    file.seek(at)
    offset = int.from_bytes(file.read(8), "little")
    if offset >= from_offset:
        _write_at(file, at, (offset + moved).to_bytes(8, "little"))


def _write_at(file: IO[bytes], at: int, data: bytes) -> None:
    file.seek(at)
    file.write(data)
