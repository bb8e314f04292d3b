"""LAS and LAZ files: one cloud, or a folder of them; read by laspy."""

import io
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import date
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.errors import InputError, import_extra
from stillmap.core.files import atomic_file, require_new_file
from stillmap.core.recording import Recording
from stillmap.io.point_cloud.binary_table import truncated_error
from stillmap.io.point_cloud.files import iter_map_points, require_nonempty_file
from stillmap.io.point_cloud.scans import Cloud, Origin, PointBuffer, read_clouds
from stillmap.io.text_lines import Progress
from stillmap.preprocessing.options import ReadOptions

EXTENSIONS = (".las", ".laz")
MAGIC = b"LASF"

_BLOCK, _BLOCK_BYTES = 1 << 16, 8 << 20  # points read together, bytes of them
_POINTS_PER_BYTE, _SURELY_FINE = 20, 10_000_000  # packed points take a byte each, and more
_HEADER = 227  # bytes that every header has
_EXTRA = 54  # bytes that a record after the header has at least
_PACKED = 0xC0  # bits of the format of points
_SMALLEST_CHUNK = 20  # bytes: its first point is not packed
_SCALE = 0.0001  # m, of what is written


def read(
    path: Path,
    options: ReadOptions,
    progress: Progress | None = None,
    scratch: Path | None = None,
) -> Recording:
    """Read one LAS or LAZ file or a folder of them.

    Raises:
        InputError: no cloud can be read, or laspy is missing.
    """
    import_extra("laspy", path)
    return read_clouds(path, "LAS", EXTENSIONS, _cloud, options, progress, scratch)


def _cloud(path: Path, origin: Origin, scratch: Path | None) -> Cloud:
    require_nonempty_file(path)
    _require_sound(path)
    laspy = import_extra("laspy", path)
    points, promised, found = PointBuffer(origin, scratch), 0, 0
    # one thread: the others believe the sizes of chunks
    backend = laspy.LazBackend.Lazrs
    with _refused(path), laspy.open(path, read_evlrs=False, laz_backend=backend) as reader:
        promised = reader.header.point_count
        if promised > max(_POINTS_PER_BYTE * path.stat().st_size, _SURELY_FINE):
            raise truncated_error(path, 0, promised)
        rows = max(1, min(_BLOCK, _BLOCK_BYTES // reader.header.point_format.size))
        for block in reader.chunk_iterator(rows):
            if len(block) > rows:
                raise InputError("is damaged: the size of its points", where=str(path))
            points.add(np.stack([block.x, block.y, block.z], axis=1))
            found += len(block)
    if found < promised:
        raise truncated_error(path, found, promised)
    return Cloud(points.finish())


def _require_sound(path: Path) -> None:
    """Refuse counts that the libraries would believe, and run out of time or memory over.

    Raises:
        InputError: see there; or lazrs is missing.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(_HEADER)
        if len(head) < _HEADER or head[:4] != MAGIC:
            raise InputError("is no LAS file", where=str(path))
        header_size, start, extras, kind = struct.unpack_from("<HIIB", head, 94)
        if not header_size + _EXTRA * extras <= start <= size:
            raise InputError("is damaged: its header", where=str(path))
        if kind & _PACKED:
            import_extra("lazrs", path)
        if kind & _PACKED and _chunks(file, start, size) > size // _SMALLEST_CHUNK:
            raise InputError("is damaged: its table of chunks", where=str(path))


def _chunks(file: IO[bytes], start: int, size: int) -> int:
    """How many chunks a packed file says it has."""
    file.seek(start)
    table = int.from_bytes(file.read(8), "little", signed=True)
    if table == -1:  # its place was not known when the points were written
        file.seek(size - 8)
        table = int.from_bytes(file.read(8), "little", signed=True)
    if not start <= table <= size - 8:
        return size  # none at all
    file.seek(table + 4)
    return int.from_bytes(file.read(4), "little")


@contextmanager
def _refused(path: Path) -> Iterator[None]:
    """Whatever the library makes of damaged bytes is an InputError."""
    try:
        with np.errstate(all="ignore"):
            yield
    except (InputError, MemoryError):
        raise
    except BaseException as error:
        # Rust's panics are no Exception
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        what = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"is damaged: {what}", where=str(path)) from error


def write(
    recording: Recording, path: str | Path, poses: NDArray[np.float64], *, overwrite: bool = False
) -> None:
    """Write one cloud of all hits in the map frame, LAZ where the name ends so.

    Coordinates are rounded to 0.1 mm. It appears whole or not at all.

    Args:
        recording: T scans.
        path: the file.
        poses: (T, D+1, D+1) T_map_base.
        overwrite: replace a file.

    Raises:
        InputError: `path` is taken or cannot be written to, or laspy is missing.
    """
    path = Path(path)
    require_new_file(path, overwrite)
    laspy = import_extra("laspy", path, "written")
    head, packed = _header(laspy, poses), path.name.lower().endswith(".laz")
    with atomic_file(path) as work, open_las_writer(work, laspy, head, packed) as writer:
        for points in iter_map_points(recording, poses):
            block = laspy.ScaleAwarePointRecord.zeros(len(points), header=head)
            block.x, block.y, block.z = points.T
            writer.write_points(block)


@contextmanager
def open_las_writer(path: Path, laspy: Any, head: Any, packed: bool) -> Iterator[Any]:
    """A writer of laspy.

    Args:
        path: a new file.
        laspy: the library.
        head: a LasHeader.
        packed: LAZ.

    Raises:
        OSError: the file cannot be written; what packs points makes an error of its own of that.
    """
    with _Remembering(io.FileIO(path, "w")) as file:
        try:
            with laspy.open(file, "w", header=head, do_compress=packed, closefd=False) as writer:
                yield writer
        except Exception as error:
            if file.failed is not None:
                raise file.failed from error
            raise


class _Remembering(io.BufferedWriter):
    """A file that knows why it could not be written."""

    failed: OSError | None = None

    def write(self, data: Any) -> int:
        try:
            return super().write(data)
        except OSError as error:
            self.failed = error
            raise


def _header(laspy: Any, poses: NDArray[np.float64]) -> Any:
    head = laspy.LasHeader(point_format=0, version="1.2")
    head.scales = np.full(3, _SCALE)
    # coordinates are 32 bit: they count from where the robot began
    head.offsets = np.zeros(3)
    if len(poses):
        head.offsets[: poses.shape[-1] - 1] = np.round(poses[0, :-1, -1])
    head.generating_software = "stillmap"
    # the day of writing would make other bytes of the same recording
    head.creation_date = date(1970, 1, 1)
    return head
