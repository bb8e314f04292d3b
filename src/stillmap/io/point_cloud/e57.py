"""E57 files: every scan of a file is one of the recording, with the place of its scanner.

libe57 does the reading (by pye57). Counts in a file are believed as far as its size goes.
"""

import re
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.errors import InputError, import_extra
from stillmap.core.recording import Recording
from stillmap.io.point_cloud.binary_table import truncated_error
from stillmap.io.point_cloud.files import list_files, pose_from_quaternion, require_nonempty_file
from stillmap.io.point_cloud.scans import (
    Cloud,
    CloudSource,
    DatasetInfo,
    Origin,
    PointBuffer,
    build_recording,
)
from stillmap.io.text_lines import Progress
from stillmap.preprocessing.options import ReadOptions

EXTENSIONS = (".e57",)
MAGIC = b"ASTM-E57"

_BLOCK = 1 << 14  # points read together; libe57 keeps the space for them where packets are bad
_PAGE, _CHECKSUM = 1024, 4  # bytes
_LARGEST_XML = 16 << 20  # bytes: what libe57 makes of them takes fifty times as many
_DEEPEST = 100  # elements within each other: libe57 takes their number squared to read them
_NO_TAGS = re.compile(rb"<!\[CDATA\[.*?\]\]>|<!--.*?-->|<\?.*?\?>", re.DOTALL)
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
GPS_EPOCH_S = 315_964_800  # 6 January 1980, since 1970; leap seconds stay out


def read(
    path: Path,
    options: ReadOptions,
    progress: Progress | None = None,
    scratch: Path | None = None,
) -> Recording:
    """Read one E57 file or a folder of them.

    Raises:
        InputError: no scan can be read, or pye57 is missing.
    """
    import_extra("pye57.libe57", path)
    files = [path] if path.is_file() else list_files(path, EXTENSIONS)
    origin, sources = Origin(), []
    for file in files:
        try:
            count = _scan_count(file)
        except InputError:
            if path.is_file():
                raise
            count = 1  # it is found out again, and counted
        for scan in range(count):
            name = file.name if count == 1 else f"{file.name} scan {scan + 1}"
            sources.append(CloudSource(name, partial(_cloud, file, scan, origin, scratch)))
    known = DatasetInfo(path, "E57", [], single=path.is_file() and len(sources) == 1)
    recording = build_recording(sources, known, options, progress, scratch)
    if recording.T_recorded_base is None:
        recording.source.update(origin.notes())
        recording.source["warnings"] += origin.warnings()
    return recording


class _Opened:
    """An open file; whatever the library makes of damaged bytes is an InputError."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.library = import_extra("pye57.libe57", path)

    def __enter__(self) -> Any:
        require_nonempty_file(self._path)
        if not str(self._path).isprintable():
            raise InputError("has a name that its library cannot open", where=str(self._path))
        _refuse_entities(self._path)
        try:
            self._file = self.library.ImageFile(str(self._path), "r")
        except Exception as error:
            raise self._damaged(error) from error
        return self._file

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        self._file.close()
        if isinstance(error, Exception) and not isinstance(error, InputError | MemoryError):
            raise self._damaged(error) from error

    def _damaged(self, error: Exception) -> InputError:
        what = (str(error).splitlines() or [type(error).__name__])[0]
        return InputError(f"is damaged: {what}", where=str(self._path))


def _refuse_entities(path: Path) -> None:
    """Refuse descriptions with entities, which could unpack to anything.

    The checksums of pages are cut out, so that nothing hides behind them.
    """
    with path.open("rb") as file:
        head = file.read(48)
        start, length = (int.from_bytes(head[at : at + 8], "little") for at in (24, 32))
        if len(head) < 48 or head[:8] != MAGIC:
            raise InputError("is no E57 file", where=str(path))
        if length > _LARGEST_XML or start > path.stat().st_size:
            raise InputError("is damaged: its description", where=str(path))
        first = start // _PAGE * _PAGE
        file.seek(first)
        pages = file.read((length // (_PAGE - _CHECKSUM) + 2) * _PAGE)
    kept = (pages[at : at + _PAGE - _CHECKSUM] for at in range(0, len(pages), _PAGE))
    text = b"".join(kept)[start - first :][:length]
    # another encoding could hide them; the standard has this one
    if re.match(rb"(\xef\xbb\xbf)?\s*<\?xml[^>]*encoding=.utf-8", text, re.IGNORECASE) is None:
        raise InputError("is damaged: its description is no XML in UTF-8", where=str(path))
    if b"<!DOCTYPE" in text:
        raise InputError("is refused: its description defines entities", where=str(path))
    if _depth(text) > _DEEPEST:
        raise InputError("is refused: its description is nested too deeply", where=str(path))


def _depth(xml: bytes) -> int:
    """How many elements lie within each other, at most."""
    depth = deepest = 0
    for tag in re.finditer(rb"<(/?)[^<>]*?(/?)>", _NO_TAGS.sub(b"", xml)):
        if tag[1]:
            depth -= 1
        elif not tag[2]:
            depth += 1
            deepest = max(deepest, depth)
    return deepest


def _scan_count(path: Path) -> int:
    with _Opened(path) as file:
        root = file.root()
        return len(root["data3D"]) if root.isDefined("data3D") else 0


def _cloud(path: Path, scan: int, origin: Origin, scratch: Path | None) -> Cloud:
    opened = _Opened(path)
    with opened as file:
        node = file.root()["data3D"][scan]
        T = _pose(node)
        if T is not None and not np.array_equal(T, np.eye(4)):
            origin = Origin(np.zeros(3))
        growing = PointBuffer(origin, scratch)
        points, fields = node["points"], _fields(opened.library, node, path)
        promised, found = points.childCount(), 0
        if promised > 8 * path.stat().st_size:
            raise truncated_error(path, 0, promised)  # not even a bit for each
        values = {name: np.zeros(_BLOCK, kind) for name, kind in fields.items()}
        buffers = opened.library.VectorSourceDestBuffer()
        for name, array in values.items():
            buffers.append(opened.library.SourceDestBuffer(file, name, array, _BLOCK, True, True))
        with closing(points.reader(buffers)) as reader:
            while n := reader.read():
                growing.add(_xyz(values, n))
                found += n
        stamp_ns = _stamp_ns(node)
    if found < promised:
        raise truncated_error(path, found, promised)
    return Cloud(growing.finish(), T, stamp_ns=stamp_ns)


def _fields(library: Any, node: Any, path: Path) -> dict[str, str]:
    """The columns to read and NumPy's names of their types.

    Raises:
        InputError: there are no coordinates.
    """
    prototype = library.StructureNode(node["points"].prototype())
    for names, state in (
        (_CARTESIAN, "cartesianInvalidState"),
        (_SPHERICAL, "sphericalInvalidState"),
    ):
        if all(prototype.isDefined(name) for name in names):
            found = dict.fromkeys(names, "d")
            return found | ({state: "b"} if prototype.isDefined(state) else {})
    raise InputError("holds a scan without coordinates", where=str(path))


def _xyz(values: dict[str, NDArray[Any]], n: int) -> NDArray[np.float64]:
    """(n, 3) metres, NaN where a point is marked as invalid."""
    columns = [array[:n] for array in values.values()]
    xyz = np.stack(columns[:3], axis=1)
    if "sphericalRange" in values:
        length, azimuth, elevation = columns[:3]
        flat = length * np.cos(elevation)
        xyz = np.stack(
            [flat * np.cos(azimuth), flat * np.sin(azimuth), length * np.sin(elevation)], axis=1
        )
    if len(columns) > 3:
        xyz[columns[3] != 0] = np.nan
    return xyz


def _pose(node: Any) -> NDArray[np.float64] | None:
    if not node.isDefined("pose"):
        return None
    pose = node["pose"]
    wxyz, xyz = [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
    if pose.isDefined("rotation"):
        wxyz = [pose["rotation"][axis].value() for axis in "wxyz"]
    if pose.isDefined("translation"):
        xyz = [pose["translation"][axis].value() for axis in "xyz"]
    try:
        return pose_from_quaternion(wxyz, xyz)
    except ValueError:
        return None


def _stamp_ns(node: Any) -> int | None:
    """When the scan began; None where the file has not been told."""
    if not node.isDefined("acquisitionStart"):
        return None
    start = node["acquisitionStart"]
    seconds = start["dateTimeValue"].value() if start.isDefined("dateTimeValue") else 0.0
    if not 0.0 < seconds < 5e9:
        return None
    return round((seconds + GPS_EPOCH_S) * 1e9)
