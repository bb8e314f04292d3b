"""LAS and LAZ point clouds: single files or folders; read and written by laspy."""

import io
import struct
from collections.abc import Iterator
from contextlib import closing, contextmanager
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from stillmap.core.array_types import Float
from stillmap.core.errors import InputError, import_extra
from stillmap.core.files import atomic_file
from stillmap.core.input_files import InputFile
from stillmap.core.recording import Recording
from stillmap.core.source import Source
from stillmap.io.builder import ReadContext
from stillmap.io.point_cloud import clouds
from stillmap.io.point_cloud.table import gather_points, open_table, require_all, truncated_error

EXTENSIONS, MAGIC = (".las", ".laz"), b"LASF"

_BLOCK, _BLOCK_BYTES = 1 << 16, 8 << 20  # points and bytes read at once
_MAX_POINTS_PER_BYTE, _MIN_POINT_LIMIT = 20, 10_000_000  # compressed points take a byte or more
_HEADER, _MIN_POINT = 227, 20  # bytes of the smallest header, and of the smallest point
_COMPRESSED = 0xC0  # bits of the point format
_LAYERED = 3  # compressor of the formats from 6 on: the columns of a chunk are layers
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}  # of a point, colors, infrared and wave packets
_BYTES = 14  # extra bytes, a layer each
SCALE = 0.0001  # m, coordinate step of written files
MAX_INTEGER = 2**31 - 1  # of a coordinate in steps


def read(path: Path, context: ReadContext) -> Recording:
    """Read one LAS or LAZ file or a folder of them.

    Raises:
        InputError: no cloud can be read, or laspy is missing.
    """
    import_extra("laspy", path)
    notes = Source(str(path), format="LAS")
    return clouds.read_clouds(notes, EXTENSIONS, _read_cloud, context)


def _read_cloud(path: Path, origin: clouds.Origin, scratch: Path | None) -> clouds.Cloud:
    with open_las_reader(path) as reader:
        columns = ([block.x, block.y, block.z] for block in iter_blocks(reader, path))
        blocks = require_all(columns, reader.header.point_count, path)
        points, _ = gather_points(blocks, origin.shift, scratch)
    return clouds.Cloud(points)


@contextmanager
def open_las_reader(path: Path) -> Iterator[Any]:
    """Open a laspy reader of a file whose header is plausible.

    Raises:
        InputError: it is no LAS file, damaged, or laspy or lazrs is missing.
    """
    laspy = import_extra("laspy", path)
    with open_table(path) as file:
        table = _check_header(file, path)
        # single-threaded: the parallel backend trusts chunk sizes
        backend = laspy.LazBackend.Lazrs
        file.seek(0)
        with clouds.library_errors(path):
            reader = laspy.open(file, closefd=False, read_evlrs=False, laz_backend=backend)
        with closing(reader):
            if table is not None:
                at = file.tell()
                _check_layers(file, reader.header, table, path)
                file.seek(at)
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
    with clouds.library_errors(path):
        for block in reader.chunk_iterator(rows):
            if len(block) > rows:
                raise InputError("is damaged: the size of its points", where=str(path))
            yield block


def _check_header(file: InputFile, path: Path) -> int | None:
    """Position of the chunk table of a compressed file, in bytes; None: not compressed.

    Raises:
        InputError: the libraries would run out of time or memory, or lazrs is missing.
    """
    head = file.read(_HEADER)
    if len(head) < _HEADER or head[:4] != MAGIC:
        raise InputError("is no LAS file", where=str(path))
    header_size, start, extras, kind = struct.unpack_from("<HIIB", head, 94)
    # a variable length record has at least 54 bytes
    if not header_size + 54 * extras <= start <= file.size:
        raise InputError("is damaged: its header", where=str(path))
    if not kind & _COMPRESSED:
        return None
    import_extra("lazrs", path)
    table = _read_number(file, start, 8)
    if table == 2**64 - 1:  # streamed: the offset is at the end of the file
        table = _read_number(file, file.size - 8, 8)
    # the first point of a chunk is not compressed
    is_inside = start <= table <= file.size - 8
    if not is_inside or _read_number(file, table + 4, 4) > file.size // _MIN_POINT:
        raise InputError("is damaged: its table of chunks", where=str(path))
    return table


def _check_layers(file: InputFile, header: Any, table: int, path: Path) -> None:
    """Refuse chunks whose layers do not fill the file up to the table: lazrs makes room for as many
    bytes as each layer states.

    Raises:
        InputError: they are longer or shorter.
    """
    with clouds.library_errors(path):
        record = header.vlrs.get("LasZipVlr")[0].record_data
        compressor, n_items = struct.unpack_from("<H30xH", record)
        if compressor != _LAYERED:
            return
        items = np.frombuffer(record, "<u2", 3 * n_items, 34).reshape(-1, 3).astype(int)
        layers = sum(size if kind == _BYTES else _LAYERS[kind] for kind, size, _ in items.tolist())
        at, point = header.offset_to_point_data + 8, int(items[:, 1].sum())
        if point < _MIN_POINT:
            raise ValueError(f"a point of {point} bytes")
        while at < table:
            file.seek(at + point)
            # the count of the points, then the bytes of each layer
            sizes = struct.unpack(f"<{1 + layers}I", file.read(4 + 4 * layers))
            at = file.tell() + sum(sizes[1:])
    if at > table:
        raise InputError("is damaged: the sizes of its layers", where=str(path))


def _read_number(file: InputFile, at: int, size: int) -> int:
    file.seek(at)
    return int.from_bytes(file.read(size), "little")


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
    # 32 bit coordinates, relative to the first pose
    origin = np.zeros(3)
    if len(poses):
        origin[: poses.shape[-1] - 1] = np.round(poses[0, :-1, -1])
    header, compressed = make_header(laspy, 0, "1.2", origin), path.name.lower().endswith(".laz")
    with atomic_file(path) as work, open_las_writer(work, laspy, header, compressed) as writer:
        for points in clouds.iter_map_points(recording, poses):
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


def make_header(laspy: Any, kind: int, version: str, origin: Float) -> Any:
    """A LasHeader of points of a format, whose coordinates are relative to an origin (3,)."""
    header = laspy.LasHeader(point_format=kind, version=version)
    header.scales, header.offsets = np.full(3, SCALE), origin
    header.generating_software = "stillmap"
    # fixed, so that equal recordings give equal files
    header.creation_date = date(1970, 1, 1)
    return header
