"""Write a point cloud as an E57 file with one scan, through libe57 (pye57).

pye57 does not read files with fields beyond the standard ones, nor with `timeStamp`. P(static) is
therefore written as `intensity`, from 0 to 1, and there are no times.
"""

import hashlib
import uuid
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from stillmap.core.errors import InputError, import_extra
from stillmap.io.point_cloud.e57 import GPS_EPOCH_S
from stillmap.io.point_cloud.las import MAX_INTEGER, SCALE
from stillmap.results.point_cloud import Block, Cloud

_BLOCK = 1 << 16  # points written at a time
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
    require_name(path)
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
    root = file.root()
    file.extensionsAdd("", library.E57_V1_0_URI)
    root.set("formatName", library.StringNode(file, "ASTM E57 3D Imaging Data File"))
    root.set("versionMajor", library.IntegerNode(file, library.E57_FORMAT_MAJOR))
    root.set("versionMinor", library.IntegerNode(file, library.E57_FORMAT_MINOR))
    root.set("e57LibraryVersion", library.StringNode(file, library.E57_LIBRARY_ID))
    root.set("coordinateMetadata", library.StringNode(file, ""))
    scans = library.VectorNode(file, True)
    root.set("data3D", scans)
    root.set("images2D", library.VectorNode(file, True))
    scan = library.StructureNode(file)
    scans.append(scan)
    scan.set("name", library.StringNode(file, "points in the map frame"))
    text = "intensity is the probability that the point is static"
    scan.set("description", library.StringNode(file, f"stillmap: {text}"))
    shares = {"intensityMinimum": 0.0, "intensityMaximum": 1.0}
    scan.set("intensityLimits", _float_nodes(library, file, shares))
    if cloud.has_colors:
        limits = library.StructureNode(file)
        for name in _COLORS:
            limits.set(f"{name}Minimum", library.IntegerNode(file, 0, 0, 255))
            limits.set(f"{name}Maximum", library.IntegerNode(file, 255, 0, 255))
        scan.set("colorLimits", limits)
    if cloud.start_ns is not None and cloud.start_ns >= GPS_EPOCH_S * 10**9:
        start = {"dateTimeValue": 1e-9 * cloud.start_ns - GPS_EPOCH_S}
        scan.set("acquisitionStart", _float_nodes(library, file, start))
    codecs, columns = library.VectorNode(file, True), _Columns(library, file, cloud)
    points = library.CompressedVectorNode(file, columns.prototype, codecs)
    scan.set("points", points)
    with closing(points.writer(columns.buffers)) as writer:
        for block in cloud.iter_blocks(progress):
            for n in columns.fill(block):
                writer.write(n)
    scan.set("cartesianBounds", _float_nodes(library, file, columns.bounds()))
    # derived from the points, so that the file is reproducible
    for node, name in ((root, "file"), (scan, "scan")):
        guid = uuid.uuid5(uuid.NAMESPACE_URL, f"{name} {columns.digest.hexdigest()}")
        node.set("guid", library.StringNode(file, f"{{{guid}}}"))


def _float_nodes(library: Any, file: Any, values: dict[str, float]) -> Any:
    node = library.StructureNode(file)
    for name, value in values.items():
        node.set(name, library.FloatNode(file, float(value)))
    return node


class _Columns:
    """The buffers from which libe57 writes the points."""

    def __init__(self, library: Any, file: Any, cloud: Cloud) -> None:
        self._origin = cloud.origin
        self._low, self._high = np.full(3, np.inf), np.full(3, -np.inf)
        self.digest = hashlib.sha256()
        self.prototype = library.StructureNode(file)
        nodes = {
            name: library.ScaledIntegerNode(
                file, 0, -MAX_INTEGER, MAX_INTEGER, SCALE, float(center)
            )
            for name, center in zip(_AXES, cloud.origin, strict=True)
        }
        nodes["intensity"] = library.FloatNode(file, 0.0, library.E57_SINGLE, 0.0, 1.0)
        if cloud.has_colors:
            nodes |= {name: library.IntegerNode(file, 0, 0, 255) for name in _COLORS}
        self._values = [np.zeros(_BLOCK) for _ in nodes]
        self.buffers = library.VectorSourceDestBuffer()
        for (name, node), values in zip(nodes.items(), self._values, strict=True):
            self.prototype.set(name, node)
            self.buffers.append(library.SourceDestBuffer(file, name, values, _BLOCK, True, True))

    def fill(self, block: Block) -> Iterator[int]:
        """Fill the buffers with the points, block by block; yields the number of points in them."""
        for part in block.split(_BLOCK):
            n, points = len(part.points), part.points
            if np.abs(points - self._origin).max() >= MAX_INTEGER * SCALE:
                what = "cannot be written: a point is beyond the range of E57 coordinates"
                raise InputError(what)
            self._low = np.minimum(self._low, points.min(axis=0))
            self._high = np.maximum(self._high, points.max(axis=0))
            columns = [*points.T, part.p_static, *(() if part.colors is None else part.colors.T)]
            for buffer, column in zip(self._values, columns, strict=True):
                buffer[:n] = column
                self.digest.update(buffer[:n].data)
            yield n

    def bounds(self) -> dict[str, float]:
        """`cartesianBounds` of the points so far."""
        if not np.isfinite(self._low).all():
            return {}
        limits = {"Minimum": self._low, "Maximum": self._high}
        return {f"{axis}{end}": at[k] for k, axis in enumerate("xyz") for end, at in limits.items()}
