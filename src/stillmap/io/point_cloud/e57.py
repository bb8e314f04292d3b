"""E57 files: every scan of a file becomes a scan of the recording, with its scanner pose.

Read by libe57 (through pye57). Counts are checked against the size of the file.
"""

import re
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import ArrayBuilder
from stillmap.core.errors import InputError, MissingExtra, import_extra
from stillmap.core.input_files import InputFile
from stillmap.core.recording import Recording
from stillmap.core.timestamps import MAX_STAMP_NS
from stillmap.io.builder import ReadContext
from stillmap.io.point_cloud.binary_table import truncated_error
from stillmap.io.point_cloud.library_errors import damaged_error, library_errors
from stillmap.io.point_cloud.origin import Origin
from stillmap.io.point_cloud.scans import Cloud, CloudSource, DatasetInfo, build_recording, files_of
from stillmap.io.point_cloud.signatures import E57_EXTENSIONS, E57_MAGIC
from stillmap.io.rigid_transforms import pose_from_quaternion
from stillmap.io.scan_files import require_nonempty_file

_BLOCK = 1 << 14  # points read at once; libe57 keeps the buffers where packets are damaged
_MAX_DAMAGED = 50  # scans of a file
_PAGE, _CHECKSUM = 1024, 4  # bytes
_MAX_XML = 16 << 20  # bytes: parsed by libe57 it takes fifty times as much memory
_MAX_DEPTH = 100  # nested elements: the time of libe57 grows with the square
# what begins with "<"; possessive quantifiers: a failure costs one pass, and is the last
_MARKUP = re.compile(
    rb"(?P<other><!--.*?-->|<!\[CDATA\[.*?\]\]>|<\?.*?\?>)"
    rb"|(?P<tag><[^<>\"'!?][^<>\"']*+(?:\"[^\"]*+\"[^<>\"']*+|'[^']*+'[^<>\"']*+)*+>)",
    re.DOTALL,
)
_SCHEMA = b"chemaLocation"  # of a namespace, or without one: libe57 would fetch it from anywhere
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
GPS_EPOCH_S = 315_964_800  # 6 January 1980 since 1970, without leap seconds


def read(path: Path, context: ReadContext) -> Recording:
    """Read one E57 file or a folder of them.

    Raises:
        InputError: no scan can be read, or pye57 is missing.
    """
    import_extra("pye57.libe57", path)
    origin, sources, files = Origin(), [], files_of(path, E57_EXTENSIONS)
    for file, count in zip(files, count_scans(files, path.is_file()), strict=True):
        scans = _Scans(file, origin, context.scratch)
        for scan in range(count):
            name = file.name if count == 1 else f"{file.name} scan {scan + 1}"
            read_cloud = partial(scans.read, scan)
            sources.append(CloudSource(name, read_cloud))
    info = DatasetInfo(path, "E57", [], single=path.is_file() and len(sources) == 1)
    recording = build_recording(sources, info, context)
    origin.place(recording)
    if recording.T_recorded_base is None:
        origin.add_notes(recording)
    return recording


def count_scans(files: Sequence[Path], single: bool) -> list[int]:
    """Number of scans of each file; 1 of a damaged file, which counts as skipped when it is read.

    Raises:
        InputError: a `single` file is damaged, or pye57 is missing.
    """
    counts = []
    for file in files:
        try:
            counts.append(_count_scans(file))
        except MissingExtra:
            raise
        except InputError:
            if single:
                raise
            counts.append(1)
    return counts


@contextmanager
def open_e57(path: Path) -> Iterator[tuple[Any, Any]]:
    """The library and an open file; errors of the library become InputError."""
    library = import_extra("pye57.libe57", path)
    require_nonempty_file(path)
    if not str(path).isprintable():
        raise InputError("has a name that libe57 cannot open", where=str(path))
    _check_xml(path)
    try:
        file = library.ImageFile(str(path), "r")
    except Exception as error:
        raise damaged_error(path, error) from error
    with library_errors(path), closing(file):
        yield library, file


def _check_xml(path: Path) -> None:
    """Refuse XML sections with entities (which expand without limit), schemas elsewhere, deep
    nesting or huge size.

    Page checksums are removed first, so that they cannot hide a tag.
    """
    with InputFile(path) as file:
        head = file.read(48)
        start, length = (int.from_bytes(head[at : at + 8], "little") for at in (24, 32))
        if len(head) < 48 or head[:8] != E57_MAGIC:
            raise InputError("is no E57 file", where=str(path))
        if length > _MAX_XML or start > file.size:
            raise InputError("is damaged: its XML section", where=str(path))
        first = start // _PAGE * _PAGE
        file.seek(first)
        pages = file.read((length // (_PAGE - _CHECKSUM) + 2) * _PAGE)
    kept = (pages[at : at + _PAGE - _CHECKSUM] for at in range(0, len(pages), _PAGE))
    text = b"".join(kept)[start - first :][:length]
    # other encodings could hide tags; the standard requires UTF-8
    if re.match(rb"(\xef\xbb\xbf)?\s*<\?xml[^>]*encoding=.utf-8", text, re.IGNORECASE) is None:
        raise InputError("is damaged: its XML section is not UTF-8", where=str(path))
    if b"<!DOCTYPE" in text:
        raise InputError("is refused: its XML section defines entities", where=str(path))
    depth = 0
    for tag in _iter_tags(text, path):
        if _SCHEMA in tag:
            raise InputError("is refused: its XML section names a schema to fetch", where=str(path))
        depth += -1 if tag.startswith(b"</") else not tag.endswith(b"/>")
        if depth > _MAX_DEPTH:
            raise InputError("is refused: its XML section is nested too deeply", where=str(path))


def _iter_tags(xml: bytes, path: Path) -> Iterator[bytes]:
    """The tags of elements, in one pass.

    Raises:
        InputError: a tag, comment, CDATA section or instruction does not end.
    """
    at = 0
    while (at := xml.find(b"<", at)) >= 0:
        found = _MARKUP.match(xml, at)
        if found is None:
            what = f"is damaged: byte {at} of its XML section begins what does not end"
            raise InputError(what, where=str(path))
        at = found.end()
        if found["tag"]:
            yield found["tag"]


def _count_scans(path: Path) -> int:
    with open_e57(path) as (_, file):
        root = file.root()
        return len(root["data3D"]) if root.isDefined("data3D") else 0


class _Scans:
    """The scans of a file, up to too many damaged ones: libe57 keeps 2 MB for each."""

    def __init__(self, path: Path, origin: Origin, scratch: Path | None) -> None:
        self._path, self._origin, self._scratch = path, origin, scratch
        self._damaged = 0

    def read(self, scan: int) -> Cloud:
        """Read one scan.

        Raises:
            InputError: it is damaged, or so were too many before it.
        """
        if self._damaged >= _MAX_DAMAGED:
            raise InputError("holds too many damaged scans", where=str(self._path))
        try:
            return _read_cloud(self._path, scan, self._origin, self._scratch)
        except InputError:
            self._damaged += 1
            raise


def _read_cloud(path: Path, scan: int, origin: Origin, scratch: Path | None) -> Cloud:
    with open_e57(path) as (library, file):
        node = file.root()["data3D"][scan]
        T = _read_pose(node)
        if T is not None and not np.array_equal(T, np.eye(4)):
            origin = Origin(np.zeros(3))
        growing = ArrayBuilder(np.float32, (3,), scratch)
        points, fields = node["points"], _find_fields(library, node, path)
        expected, found = points.childCount(), 0
        if expected > 8 * path.stat().st_size:
            raise truncated_error(path, 0, expected)  # less than one bit per point
        values = {name: np.zeros(_BLOCK, kind) for name, kind in fields.items()}
        buffers = library.VectorSourceDestBuffer()
        for name, array in values.items():
            buffers.append(library.SourceDestBuffer(file, name, array, _BLOCK, True, True))
        with closing(points.reader(buffers)) as reader:
            while n := reader.read():
                growing.append(origin.shift(_to_xyz(values, n)))
                found += n
        stamp_ns = _read_stamp(node)
    if found < expected:
        raise truncated_error(path, found, expected)
    return Cloud(growing.finish(), T, stamp_ns=stamp_ns)


def _find_fields(library: Any, node: Any, path: Path) -> dict[str, str]:
    """Columns to read, and the NumPy codes of their types.

    Raises:
        InputError: the scan has no coordinates.
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


def _to_xyz(values: dict[str, NDArray[Any]], n: int) -> NDArray[np.float64]:
    """(n, 3) metres, NaN for points marked as invalid."""
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


def _read_pose(node: Any) -> NDArray[np.float64] | None:
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


def _read_stamp(node: Any) -> int | None:
    """Start of the scan (ns); None: not recorded."""
    if not node.isDefined("acquisitionStart"):
        return None
    start = node["acquisitionStart"]
    seconds = start["dateTimeValue"].value() if start.isDefined("dateTimeValue") else 0.0
    if not 0.0 < seconds < MAX_STAMP_NS // 10**9 - GPS_EPOCH_S:
        return None
    return round((seconds + GPS_EPOCH_S) * 1e9)
