"""The points of a result as one file: PLY, PCD, LAS, LAZ, E57 or text, with `p_static` at each,
and where there are colours with those."""

from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.errors import InputError, import_extra
from stillmap.core.files import atomic_file
from stillmap.io.point_cloud.las import open_las_writer
from stillmap.results.export import e57
from stillmap.results.export.point_cloud import Block, Cloud
from stillmap.results.points import COLOURS, FIELDS, ply_header, put_colours

Tell = Callable[[float], None]

_SCALE = 0.0001  # m, of coordinates in LAS
_POINTS, _COLOURED = 6, 7  # the LAS formats of points that have a time, and a colour too
_FULL = 256  # LAS's colours are 16 bit: so many times those of pictures
_PACKED = [("rgb", "<u4")]  # 0x00RRGGBB, which PCL and others expect to be called a float
_LARGEST = 2**31 - 1  # LAS's coordinates are 32 bit
_LINES = 1 << 14  # of text, made together


class Format(NamedTuple):
    """A form of clouds.

    Attributes:
        name: what it is called on the command line.
        about: for people.
        endings: of names of such files, in small letters.
        needs: modules of stillmap's extra `io` without which it cannot be written.
        write: writes points to a path, telling which share of them is written.
    """

    name: str
    description: str
    endings: tuple[str, ...]
    requires: tuple[str, ...]
    write: Callable[[Cloud, Path, bool, Tell | None], None]


def format_for(path: Path, name: str | None = None) -> Format | None:
    """The form that is named, else that of the path's ending; None: no cloud is wanted."""
    ending = path.suffix.lower()
    for one in FORMATS:
        if one.name == name if name else ending in one.endings:
            return one
    return None


def require_extras(form: Format, path: Path) -> None:
    """Refuses what cannot be written here, before any work is done.

    Raises:
        InputError: a library is missing.
    """
    packed = path.suffix.lower() == ".laz"
    for module in (*form.requires, *(("lazrs",) if packed else ())):
        import_extra(module, path, "written")


def write(cloud: Cloud, path: Path, form: Format, tell: Tell | None = None) -> None:
    """Write the points; the file appears whole or not at all.

    Args:
        cloud: the points.
        path: where to.
        form: one of `FORMATS`.
        tell: hears which share of them is written.

    Raises:
        InputError: a library is missing, the file cannot be written or cannot hold the points.
    """
    require_extras(form, path)
    with atomic_file(path) as work:
        try:
            form.write(cloud, work, path.suffix.lower() == ".laz", tell)
        except InputError as error:
            where = str(path) if error.where in ("", str(work)) else error.where
            raise InputError(error.what, where=where, hint=error.hint) from error


def _write_ply(cloud: Cloud, path: Path, _: bool, tell: Tell | None) -> None:
    fields = FIELDS + COLOURS if cloud.has_colors else FIELDS
    _write_records(cloud, path, ply_header(fields, cloud.count), fields, tell)


def _write_pcd(cloud: Cloud, path: Path, _: bool, tell: Tell | None) -> None:
    fields = FIELDS + _PACKED if cloud.has_colors else FIELDS
    names = [name for name, _ in fields]
    lines = (
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(names)}",
        f"SIZE {' '.join('4' for _ in names)}",
        f"TYPE {' '.join('F' for _ in names)}",
        f"COUNT {' '.join('1' for _ in names)}",
        f"WIDTH {cloud.count}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {cloud.count}",
        "DATA binary",
    )
    header = "".join(f"{line}\n" for line in lines).encode()
    _write_records(cloud, path, header, fields, tell)


def _write_records(
    cloud: Cloud, path: Path, header: bytes, fields: list[tuple[str, str]], tell: Tell | None
) -> None:
    with path.open("wb") as file:
        file.write(header)
        for block in cloud.iter_blocks(tell):
            file.write(_records(block, fields).tobytes())


def _records(block: Block, fields: list[tuple[str, str]]) -> NDArray[np.void]:
    out = np.empty(len(block.points), fields)
    out["x"], out["y"], out["z"] = block.points.T
    out["p_static"] = block.p_static
    if block.colors is not None and fields[-1:] == _PACKED:
        red, green, blue = block.colors.T.astype(np.uint32)
        out["rgb"] = red << 16 | green << 8 | blue
    elif block.colors is not None:
        put_colours(out, block.colors)
    return out


def _write_text(cloud: Cloud, path: Path, _: bool, tell: Tell | None) -> None:
    names = [name for name, _ in (FIELDS + COLOURS if cloud.has_colors else FIELDS)]
    line = "%.4f %.4f %.4f %.9g" + (" %d %d %d" if cloud.has_colors else "") + "\n"
    with path.open("w", encoding="ascii", newline="\n") as file:
        file.write(" ".join(names) + "\n")
        for block in cloud.iter_blocks(tell):
            for first in range(0, len(block.points), _LINES):
                part = slice(first, first + _LINES)
                values: list[NDArray[Any]] = [
                    block.points[part],
                    block.p_static[part, None].astype(np.float64),
                ]
                if block.colors is not None:
                    values.append(block.colors[part])
                rows = np.concatenate(values, axis=1)
                file.write(line * len(rows) % tuple(rows.ravel().tolist()))


def _write_las(cloud: Cloud, path: Path, packed: bool, tell: Tell | None) -> None:
    laspy = import_extra("laspy", path, "written")
    kind = _COLOURED if cloud.has_colors else _POINTS
    head = laspy.LasHeader(point_format=kind, version="1.4")
    head.scales, head.offsets = np.full(3, _SCALE), cloud.origin
    head.add_extra_dim(laspy.ExtraBytesParams("p_static", "float32", "probability to be static"))
    head.global_encoding.wkt = True  # as LAS 1.4 wants it, also where no place on earth is known
    head.generating_software = "stillmap"
    # the day of writing would make other bytes of the same result
    head.creation_date = date(1970, 1, 1)
    with open_las_writer(path, laspy, head, packed) as writer:
        for block in cloud.iter_blocks(tell):
            writer.write_points(_las_points(laspy, head, block))


def _las_points(laspy: Any, head: Any, block: Block) -> Any:
    if np.abs(block.points - head.offsets).max(initial=0.0) >= _LARGEST * _SCALE:
        raise InputError("cannot be written: a point lies farther off than LAS can say")
    out = laspy.ScaleAwarePointRecord.zeros(len(block.points), header=head)
    out.x, out.y, out.z = block.points.T
    out.return_number = out.number_of_returns = np.ones(len(block.points), np.uint8)
    out["p_static"] = block.p_static
    if block.stamp_ns is not None:
        out.gps_time = 1e-9 * block.stamp_ns
    if block.colors is not None:
        out.red, out.green, out.blue = block.colors.T.astype(np.uint16) * np.uint16(_FULL)
    return out


def _write_e57(cloud: Cloud, path: Path, _: bool, tell: Tell | None) -> None:
    e57.write(cloud, path, tell)


FORMATS = (
    Format("las", "a LAS file", (".las", ".laz"), ("laspy",), _write_las),
    Format("e57", "an E57 file", (".e57",), ("pye57.libe57",), _write_e57),
    Format("pcd", "a PCD file", (".pcd",), (), _write_pcd),
    Format("ply", "a PLY file", (".ply",), (), _write_ply),
    Format("xyz", "lines of text", (".xyz",), (), _write_text),
)
