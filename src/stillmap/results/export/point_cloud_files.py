"""Write a point cloud with `p_static` and colors as PLY, PCD, LAS, LAZ, E57 or text."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from stillmap.core.errors import InputError, import_extra
from stillmap.core.files import atomic_file
from stillmap.io.point_cloud import las, pcd, ply
from stillmap.io.point_cloud.table import Fields
from stillmap.results import point_cloud
from stillmap.results.export import e57
from stillmap.results.point_cloud import Block, Cloud, make_vertices

Progress = Callable[[float], None]

_POINT_FORMAT, _COLOR_POINT_FORMAT = 6, 7  # of LAS: with time, and with color too
_COLOR_SCALE = 256  # LAS has 16-bit colors


class Format(NamedTuple):
    """A file format of point clouds.

    Attributes:
        name: on the command line.
        description: for messages.
        endings: of file names, lower case.
        requires: modules of the extra `io` that writing needs.
        write: writes a cloud to a path; arguments: compressed (LAZ), progress.
    """

    name: str
    description: str
    endings: tuple[str, ...]
    requires: tuple[str, ...]
    write: Callable[[Cloud, Path, bool, Progress | None], None]


def format_for(path: Path, name: str | None = None) -> Format | None:
    """The format by name, else by the ending of the path; None if there is none."""
    ending = path.suffix.lower()
    for one in FORMATS:
        if one.name == name if name else ending in one.endings:
            return one
    return None


def require_extras(file_format: Format, path: Path) -> None:
    """Check that the libraries for a format are installed, and can open a file of this name.

    Raises:
        InputError: a library is missing, or cannot.
    """
    compressed = path.suffix.lower() == ".laz"
    for module in (*file_format.requires, *(("lazrs",) if compressed else ())):
        import_extra(module, path, "written")
    if file_format.name == "e57":
        e57.require_name(path)


def write(cloud: Cloud, path: Path, file_format: Format, progress: Progress | None = None) -> None:
    """Write a cloud atomically.

    Args:
        cloud: the points.
        path: the file.
        file_format: one of `FORMATS`.
        progress: called with the share of the points that is written.

    Raises:
        InputError: a library is missing, the file cannot be written or cannot hold the points.
    """
    require_extras(file_format, path)
    with atomic_file(path) as work:
        try:
            file_format.write(cloud, work, path.suffix.lower() == ".laz", progress)
        except InputError as error:
            where = str(path) if error.where in ("", str(work)) else error.where
            raise InputError(error.what, where=where, hint=error.hint) from error


def _write_ply(cloud: Cloud, path: Path, _: bool, progress: Progress | None) -> None:
    fields = point_cloud.cloud_fields(cloud, point_cloud.COLOURS)
    _write_records(cloud, path, ply.make_header(fields, cloud.count), fields, progress)


def _write_pcd(cloud: Cloud, path: Path, _: bool, progress: Progress | None) -> None:
    fields = point_cloud.cloud_fields(cloud, point_cloud.PACKED_COLOUR)
    _write_records(cloud, path, pcd.make_header(fields, cloud.count, np.eye(4)), fields, progress)


def _write_records(
    cloud: Cloud, path: Path, header: bytes, fields: Fields, progress: Progress | None
) -> None:
    with path.open("wb") as file:
        file.write(header)
        for block in cloud.iter_blocks(progress):
            file.write(make_vertices(block, fields).tobytes())


def _write_text(cloud: Cloud, path: Path, _: bool, progress: Progress | None) -> None:
    names = [name for name, _ in point_cloud.cloud_fields(cloud, point_cloud.COLOURS)]
    line = "%.4f %.4f %.4f %.9g" + (" %d %d %d" if cloud.has_colors else "") + "\n"
    with path.open("w", encoding="ascii", newline="\n") as file:
        file.write(" ".join(names) + "\n")
        for block in cloud.iter_blocks(progress):
            colors = np.zeros((len(block.points), 0)) if block.colors is None else block.colors
            rows = np.column_stack([block.points, block.p_static.astype(np.float64), colors])
            file.write(line * len(rows) % tuple(rows.ravel().tolist()))


def _write_las(cloud: Cloud, path: Path, compressed: bool, progress: Progress | None) -> None:
    laspy = import_extra("laspy", path, "written")
    kind = _COLOR_POINT_FORMAT if cloud.has_colors else _POINT_FORMAT
    header = las.make_header(laspy, kind, "1.4", cloud.origin)
    header.add_extra_dim(laspy.ExtraBytesParams("p_static", "float32", "probability to be static"))
    header.global_encoding.wkt = True  # required by LAS 1.4, even without a coordinate system
    with las.open_las_writer(path, laspy, header, compressed) as writer:
        for block in cloud.iter_blocks(progress):
            writer.write_points(_las_points(laspy, header, block))


def _las_points(laspy: Any, header: Any, block: Block) -> Any:
    if np.abs(block.points - header.offsets).max(initial=0.0) >= las.MAX_INTEGER * las.SCALE:
        raise InputError("cannot be written: a point is beyond the range of LAS coordinates")
    out = laspy.ScaleAwarePointRecord.zeros(len(block.points), header=header)
    out.x, out.y, out.z = block.points.T
    out.return_number = out.number_of_returns = np.ones(len(block.points), np.uint8)
    out["p_static"] = block.p_static
    if block.stamp_ns is not None:
        out.gps_time = 1e-9 * block.stamp_ns
    if block.colors is not None:
        out.red, out.green, out.blue = block.colors.T.astype(np.uint16) * np.uint16(_COLOR_SCALE)
    return out


FORMATS = (
    Format("las", "a LAS file", (".las", ".laz"), ("laspy",), _write_las),
    Format("e57", "an E57 file", (".e57",), ("pye57.libe57",), e57.write),
    Format("pcd", "a PCD file", (".pcd",), (), _write_pcd),
    Format("ply", "a PLY file", (".ply",), (), _write_ply),
    Format("xyz", "lines of text", (".xyz",), (), _write_text),
)
