"""LAS and LAZ point clouds: single files or folders; read and written by laspy."""

import io
import struct
from collections.abc import Iterator
from contextlib import closing, contextmanager
from datetime import date
from pathlib import Path
from typing import IO, Any

import numpy as np

from stillmap.core.array_types import Float
from stillmap.core.errors import InputError, import_extra
from stillmap.core.files import atomic_file
from stillmap.core.input_files import InputFile
from stillmap.core.recording import Recording
from stillmap.io.builder import ReadContext
from stillmap.io.point_cloud.clouds import (
    Cloud,
    Origin,
    iter_map_points,
    library_errors,
    read_clouds,
)
from stillmap.io.point_cloud.table import gather_points, open_table, require_all, truncated_error

EXTENSIONS, MAGIC = (".las", ".laz"), b"LASF"

_BLOCK, _BLOCK_BYTES = 1 << 16, 8 << 20  # points and bytes read at once
_MAX_POINTS_PER_BYTE, _MIN_POINT_LIMIT = 20, 10_000_000  # compressed points take a byte or more
_HEADER = 227  # bytes of the smallest header
_COMPRESSED = 0xC0  # bits of the point format
SCALE = 0.0001  # m, coordinate step of written files
MAX_INTEGER = 2**31 - 1  # of a coordinate in steps


def read(path: Path, context: ReadContext) -> Recording:
    """Read one LAS or LAZ file or a folder of them.

    Raises:
        InputError: no cloud can be read, or laspy is missing.
    """
    import_extra("laspy", path)
    return read_clouds(path, "LAS", EXTENSIONS, _read_cloud, context)


def _read_cloud(path: Path, origin: Origin, scratch: Path | None) -> Cloud:
    with open_las_reader(path) as reader:
        columns = ([block.x, block.y, block.z] for block in iter_blocks(reader, path))
        blocks = require_all(columns, reader.header.point_count, path)
        points, _ = gather_points(blocks, origin.shift, scratch)
    return Cloud(points)


@contextmanager
def open_las_reader(path: Path) -> Iterator[Any]:
    """Open a laspy reader of a file whose header is plausible.

    Raises:
        InputError: it is no LAS file, damaged, or laspy or lazrs is missing.
    """
    _check_header(path)
    laspy = import_extra("laspy", path)
    # single-threaded: the parallel backend trusts chunk sizes
    backend = laspy.LazBackend.Lazrs
    with InputFile(path) as file:
        with library_errors(path):
            reader = laspy.open(file, closefd=False, read_evlrs=False, laz_backend=backend)
        with closing(reader):
            yield reader


def iter_blocks(reader: Any, path: Path) -> Iterator[Any]:
    """Yield the points of an open file in blocks; there may be fewer than its header states.

    Raises:
        InputError: the file is damaged.
    """
    if reader.header.point_count > max(
        _MAX_POINTS_PER_BYTE * path.stat().st_size, _MIN_POINT_LIMIT
    ):
        raise truncated_error(path)
    rows = max(1, min(_BLOCK, _BLOCK_BYTES // reader.header.point_format.size))
    with library_errors(path):
        for block in reader.chunk_iterator(rows):
            if len(block) > rows:
                raise InputError("is damaged: the size of its points", where=str(path))
            yield block


def _check_header(path: Path) -> None:
    """Refuse header counts on which the libraries would run out of time or memory.

    Raises:
        InputError: the header is invalid, or lazrs is missing.
    """
    with open_table(path) as file:
        size, head = file.size, file.read(_HEADER)
        if len(head) < _HEADER or head[:4] != MAGIC:
            raise InputError("is no LAS file", where=str(path))
        header_size, start, extras, kind = struct.unpack_from("<HIIB", head, 94)
        # a variable length record has at least 54 bytes
        if not header_size + 54 * extras <= start <= size:
            raise InputError("is damaged: its header", where=str(path))
        if kind & _COMPRESSED:
            import_extra("lazrs", path)
        # the first point of a chunk, of 20 bytes, is not compressed
        if kind & _COMPRESSED and _count_chunks(file, start, size) > size // 20:
            raise InputError("is damaged: its table of chunks", where=str(path))


def _count_chunks(file: IO[bytes], start: int, size: int) -> int:
    """Chunk count of a compressed file, as stated in it."""
    file.seek(start)
    table = int.from_bytes(file.read(8), "little", signed=True)
    if table == -1:  # streamed: the offset is at the end of the file
        file.seek(size - 8)
        table = int.from_bytes(file.read(8), "little", signed=True)
    if not start <= table <= size - 8:
        return size  # no chunk table
    file.seek(table + 4)
    return int.from_bytes(file.read(4), "little")


def write(recording: Recording, path: Path, poses: Float) -> None:
    """Write all hits in the map frame as one LAS or (by extension) LAZ cloud, atomically.

    Coordinates are rounded to 0.1 mm.

    Args:
        recording: T scans.
        path: the file; it is replaced.
        poses: (T, D+1, D+1) T_map_base.

    Raises:
        InputError: `path` cannot be written, or laspy is missing.
    """
    laspy = import_extra("laspy", path, "written")
    header, compressed = _make_header(laspy, poses), path.name.lower().endswith(".laz")
    with atomic_file(path) as work, open_las_writer(work, laspy, header, compressed) as writer:
        for points in iter_map_points(recording, poses):
            block = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
            block.x, block.y, block.z = points.T
            writer.write_points(block)


@contextmanager
def open_las_writer(path: Path, laspy: Any, header: Any, compressed: bool) -> Iterator[Any]:
    """Open a laspy writer.

    Args:
        path: a new file.
        laspy: the library.
        header: a LasHeader.
        compressed: write LAZ.

    Raises:
        OSError: the file cannot be written; the compressor would raise another error.
    """
    with _ErrorKeepingWriter(io.FileIO(path, "w")) as file:
        try:
            with laspy.open(
                file,
                "w",
                header=header,
                do_compress=compressed,
                closefd=False,
                encoding_errors="replace",  # names that are not ASCII stay bytes as they are
            ) as writer:
                yield writer
        except Exception as error:
            if file.failed is not None:
                raise file.failed from error
            raise


class _ErrorKeepingWriter(io.BufferedWriter):
    """Buffered file that keeps the error of a failed write."""

    failed: OSError | None = None

    def write(self, data: Any) -> int:
        try:
            return super().write(data)
        except OSError as error:
            self.failed = error
            raise


def _make_header(laspy: Any, poses: Float) -> Any:
    header = laspy.LasHeader(point_format=0, version="1.2")
    header.scales = np.full(3, SCALE)
    # 32 bit coordinates, relative to the first pose
    header.offsets = np.zeros(3)
    if len(poses):
        header.offsets[: poses.shape[-1] - 1] = np.round(poses[0, :-1, -1])
    header.generating_software = "stillmap"
    # fixed, so that equal recordings give equal files
    header.creation_date = date(1970, 1, 1)
    return header
