"""Write a point cloud as an E57 file with one scan, through libe57 (pye57).

pye57 does not read files with fields beyond the standard ones, nor with `timeStamp`. P(static) is
therefore written as `intensity`, from 0 to 1, and there are no times.
"""

import hashlib
import uuid
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from stillmap.core.array_types import Float
from stillmap.core.errors import InputError, import_extra
from stillmap.io.point_cloud.e57 import GPS_EPOCH_S
from stillmap.io.point_cloud.las import MAX_INTEGER, SCALE
from stillmap.results.point_cloud import MAX_BLOCK, Cloud

_AXES = ("cartesianX", "cartesianY", "cartesianZ")
_COLORS = ("colorRed", "colorGreen", "colorBlue")


def require_name(path: Path) -> None:
    """Refuse a name that libe57 cannot open.

    Raises:
        InputError: it is one.
    """
    if not str(path).isprintable():
        raise InputError("has a name that libe57 cannot open", where=str(path))


def write(
    cloud: Cloud, path: Path, _compressed: bool, progress: Callable[[float], None] | None
) -> None:
    """Write `cartesianX`, `Y`, `Z`, `intensity` and, with colors, `colorRed`, `Green`, `Blue`.

    Coordinates are rounded to 0.1 mm; colors are 0 to 255.

    Raises:
        InputError: pye57 is missing, or the file cannot be written or cannot hold the points.
        OSError: the file cannot be created.
    """
    library = import_extra("pye57.libe57", path, "written")
    path.open("wb").close()  # raises an OSError that names the reason; libe57 does not
    try:
        file = library.ImageFile(str(path), "w")
        try:
            _write_scan(library, file, cloud, progress)
            file.close()
        finally:
            if file.isOpen():
                file.cancel()  # leaves the incomplete file
    except library.E57Exception as error:
        what = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"cannot be written: {what}", where=str(path)) from error


def _write_scan(
    library: Any, file: Any, cloud: Cloud, progress: Callable[[float], None] | None
) -> None:
    columns = {
        axis: library.ScaledIntegerNode(file, 0, -MAX_INTEGER, MAX_INTEGER, SCALE, float(center))
        for axis, center in zip(_AXES, cloud.origin, strict=True)
    }
    columns["intensity"] = library.FloatNode(file, 0.0, library.E57_SINGLE, 0.0, 1.0)
    if cloud.has_colors:
        columns |= {name: library.IntegerNode(file, 0, 0, 255) for name in _COLORS}
    values, buffers = [np.zeros(MAX_BLOCK) for _ in columns], library.VectorSourceDestBuffer()
    for name, one in zip(columns, values, strict=True):
        buffers.append(library.SourceDestBuffer(file, name, one, MAX_BLOCK, True, True))
    prototype = _fill(library, file, library.StructureNode(file), columns)
    points = library.CompressedVectorNode(file, prototype, library.VectorNode(file, True))
    root, scans, scan = file.root(), library.VectorNode(file, True), library.StructureNode(file)
    file.extensionsAdd("", library.E57_V1_0_URI)
    header = {
        "formatName": "ASTM E57 3D Imaging Data File",
        "versionMajor": library.E57_FORMAT_MAJOR,
        "versionMinor": library.E57_FORMAT_MINOR,
        "e57LibraryVersion": library.E57_LIBRARY_ID,
        "coordinateMetadata": "",
        "data3D": scans,
        "images2D": library.VectorNode(file, True),
    }
    _fill(library, file, root, header)
    scans.append(scan)
    _fill(library, file, scan, {**_describe_scan(cloud), "points": points})
    with closing(points.writer(buffers)) as writer:
        digest, low, high = _write_points(writer, values, cloud, progress)
    if cloud.count:
        ends = {f"{axis}Minimum": at for axis, at in zip("xyz", low.tolist(), strict=True)}
        ends |= {f"{axis}Maximum": at for axis, at in zip("xyz", high.tolist(), strict=True)}
        _fill(library, file, scan, {"cartesianBounds": ends})
    # derived from the points, so that the file is reproducible
    for node, name in ((root, "file"), (scan, "scan")):
        guid = uuid.uuid5(uuid.NAMESPACE_URL, f"{name} {digest}")
        node.set("guid", library.StringNode(file, f"{{{guid}}}"))


def _write_points(
    writer: Any, values: list[Float], cloud: Cloud, progress: Callable[[float], None] | None
) -> tuple[str, Float, Float]:
    """Write all points through the buffers `values`; their digest, and their bounds (3,), (3,)."""
    digest, low, high = hashlib.sha256(), np.full(3, np.inf), np.full(3, -np.inf)
    for block in cloud.iter_blocks(progress):
        if np.abs(block.points - cloud.origin).max() >= MAX_INTEGER * SCALE:
            raise InputError("cannot be written: a point is beyond the range of E57 coordinates")
        low = np.minimum(low, block.points.min(axis=0))
        high = np.maximum(high, block.points.max(axis=0))
        colors = () if block.colors is None else block.colors.T
        for values_of, column in zip(
            values, [*block.points.T, block.p_static, *colors], strict=True
        ):
            values_of[: len(column)] = column
            digest.update(values_of[: len(column)].data)
        writer.write(len(block.points))
    return digest.hexdigest(), low, high


def _describe_scan(cloud: Cloud) -> dict[str, Any]:
    """Header entries of a scan: name, description, limits of intensity and colour, bounds."""
    text = "intensity is the probability that the point is static"
    scan: dict[str, Any] = {
        "name": "points in the map frame",
        "description": f"stillmap: {text}",
        "intensityLimits": {"intensityMinimum": 0.0, "intensityMaximum": 1.0},
    }
    if cloud.has_colors:
        ends = (("Minimum", 0), ("Maximum", 255))
        scan["colorLimits"] = {name + end: value for name in _COLORS for end, value in ends}
    if cloud.start_ns is not None and cloud.start_ns >= GPS_EPOCH_S * 10**9:
        scan["acquisitionStart"] = {"dateTimeValue": 1e-9 * cloud.start_ns - GPS_EPOCH_S}
    return scan


def _fill(library: Any, file: Any, node: Any, values: Mapping[str, Any]) -> Any:
    """A structure with these values: texts, numbers, nodes, and mappings of such."""
    kinds = {str: library.StringNode, int: library.IntegerNode, float: library.FloatNode}
    for name, value in values.items():
        if isinstance(value, dict):
            node.set(name, _fill(library, file, library.StructureNode(file), value))
        else:
            make = kinds.get(type(value))
            node.set(name, value if make is None else make(file, value))
    return node
