"""E57 files: every scan of a file becomes a scan of the recording, with its scanner pose.

Read by libe57 (through pye57). Counts are checked against the size of the file.
"""

import re
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np

from stillmap.core.array_types import Float
from stillmap.core.errors import InputError, MissingExtra, explaining_damage, import_extra
from stillmap.core.recording import Recording
from stillmap.core.source import Source
from stillmap.core.timestamps import MAX_STAMP_NS
from stillmap.io.builder import ReadContext
from stillmap.io.point_cloud import clouds, table
from stillmap.io.trajectory import pose_from_quaternion

EXTENSIONS, MAGIC = (".e57",), b"ASTM-E57"
GPS_EPOCH_S = 315_964_800  # 6 January 1980 since 1970, without leap seconds

_BLOCK = 1 << 14  # points read at once; libe57 keeps the buffers where packets are damaged
_MAX_DAMAGED = 50  # scans of a file: libe57 keeps 2 MB for each
_PAGE, _CHECKSUM = 1024, 4  # bytes
_MAX_XML = 16 << 20  # bytes: parsed by libe57 it takes fifty times as much memory
_MAX_DEPTH = 100  # nested elements: the time of libe57 grows with the square
_SCHEMA = "chemaLocation"  # of a namespace, or without one: libe57 would fetch it from anywhere
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")


def read(path: Path, context: ReadContext) -> Recording:
    """Read one E57 file or a folder of them.

    Raises:
        InputError: no scan can be read, or pye57 is missing.
    """
    import_extra("pye57.libe57", path)
    origin, sources, damaged = clouds.Origin(), [], Counter[Path]()
    for file in clouds.files_of(path, EXTENSIONS):
        count = _count_scans(file, single=path.is_file())
        for scan in range(count):
            name = file.name if count == 1 else f"{file.name} scan {scan + 1}"
            read_cloud = partial(_read_cloud, file, scan, origin, context.scratch, damaged)
            sources.append(clouds.CloudSource(name, read_cloud))
    single = path.is_file() and len(sources) == 1
    notes = Source(str(path), format="E57")
    recording = clouds.build_recording(sources, notes, context, single=single)
    origin.record_in(recording)
    return recording


def _count_scans(path: Path, single: bool) -> int:
    """Number of scans of a file; 1 of a damaged file, which counts as skipped when it is read.

    Raises:
        InputError: a `single` file is damaged, or pye57 is missing.
    """
    try:
        with _open_e57(path) as (_, file):
            root = file.root()
            return len(root["data3D"]) if root.isDefined("data3D") else 0
    except InputError as error:
        if single or isinstance(error, MissingExtra):
            raise
        return 1


@contextmanager
def _open_e57(path: Path) -> Iterator[tuple[Any, Any]]:
    """The library and an open file; errors of the library become InputError."""
    library = import_extra("pye57.libe57", path)
    _check_xml(path)
    with clouds.library_errors(path), closing(library.ImageFile(str(path), "r")) as file:
        yield library, file


def _check_xml(path: Path) -> None:
    """Refuse XML sections with entities (which expand without limit), schemas elsewhere, deep
    nesting or huge size: libe57 trusts them.
    """
    with table.open_table(path) as file:
        head = file.read(48)
        start, length = (int.from_bytes(head[at : at + 8], "little") for at in (24, 32))
        if len(head) < 48 or head[:8] != MAGIC or not str(path).isprintable():
            what = "is no E57 file, or has a name that libe57 cannot open"
            raise InputError(what, where=str(path))
        if length > _MAX_XML or start > file.size:
            raise InputError("is damaged: its XML section", where=str(path))
        first = start // _PAGE * _PAGE
        file.seek(first)
        pages = file.read((length // (_PAGE - _CHECKSUM) + 2) * _PAGE)
    # checksums are removed first, so that they cannot hide a tag
    kept = (pages[at : at + _PAGE - _CHECKSUM] for at in range(0, len(pages), _PAGE))
    text = b"".join(kept)[start - first :][:length]
    # other encodings could hide tags; the standard requires UTF-8
    if re.match(rb"(\xef\xbb\xbf)?\s*<\?xml[^>]*encoding=.utf-8", text, re.IGNORECASE) is None:
        raise InputError("is damaged: its XML section is not UTF-8", where=str(path))
    with explaining_damage(path, expat.ExpatError, what="is refused: its XML section"):
        _parse_xml(text)


def _parse_xml(text: bytes) -> None:
    depth = 0

    def begin(_: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > _MAX_DEPTH:
            raise ValueError("nested too deeply")
        if any(_SCHEMA in name for name in attributes):
            raise ValueError("names a schema to fetch")

    def end(_: str) -> None:
        nonlocal depth
        depth -= 1

    def refuse(*_: Any) -> None:
        raise ValueError("defines entities")

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = begin, end
    parser.StartDoctypeDeclHandler = refuse
    parser.Parse(text, True)


def _read_cloud(
    path: Path, scan: int, origin: clouds.Origin, scratch: Path | None, damaged: Counter[Path]
) -> clouds.Cloud:
    """Read one scan of a file, up to too many damaged ones."""
    if damaged[path] >= _MAX_DAMAGED:
        raise InputError("holds too many damaged scans", where=str(path))
    damaged[path] += 1
    with _open_e57(path) as (library, file):
        node = file.root()["data3D"][scan]
        T = _read_pose(node)
        if T is not None and not np.array_equal(T, np.eye(4)):
            origin = clouds.Origin(np.zeros(3))
        rows = node["points"].childCount()
        if rows > 8 * path.stat().st_size:
            raise table.truncated_error(path)  # less than one bit per point
        blocks = table.require_all(_iter_blocks(library, file, node, path), rows, path)
        points, _ = table.gather_points(blocks, origin.shift, scratch)
        stamp_ns = _read_stamp(node)
    damaged[path] -= 1
    return clouds.Cloud(points, T, stamp_ns=stamp_ns)


def _iter_blocks(library: Any, file: Any, node: Any, path: Path) -> Iterator[table.Columns]:
    """Yield x, y, z (k,) in metres, NaN for points marked as invalid.

    Raises:
        InputError: the scan has no coordinates.
    """
    prototype = library.StructureNode(node["points"].prototype())
    named = (_CARTESIAN, "cartesianInvalidState"), (_SPHERICAL, "sphericalInvalidState")
    usable = [form for form in named if all(prototype.isDefined(name) for name in form[0])]
    if not usable:
        raise InputError("holds a scan without coordinates", where=str(path))
    names, state = usable[0]
    values = {name: np.zeros(_BLOCK) for name in names}
    if prototype.isDefined(state):
        values[state] = np.zeros(_BLOCK, np.int8)
    buffers = library.VectorSourceDestBuffer()
    for name, array in values.items():
        buffers.append(library.SourceDestBuffer(file, name, array, _BLOCK, True, True))
    with closing(node["points"].reader(buffers)) as reader:
        while n := reader.read():
            columns = [values[name][:n] for name in names]
            if names == _SPHERICAL:
                length, azimuth, elevation = columns
                flat = length * np.cos(elevation)
                xyz = flat * np.cos(azimuth), flat * np.sin(azimuth), length * np.sin(elevation)
                columns = list(xyz)
            invalid = values[state][:n] != 0 if state in values else np.zeros(n, np.bool_)
            yield [np.where(invalid, np.nan, column) for column in columns]


def _read_pose(node: Any) -> Float | None:
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
