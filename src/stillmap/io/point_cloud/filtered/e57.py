"""Filtered copies of E57 files: the tree of the file is built anew by libe57, value by value."""

from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.errors import InputError, import_extra
from stillmap.io.filtered_copy import FilterJob, Mask, Omissions, require_rows, write_files
from stillmap.io.point_cloud import e57
from stillmap.io.point_cloud.scans import files_of
from stillmap.io.point_cloud.signatures import E57_EXTENSIONS

_BLOCK = 1 << 14  # points copied at once
_PIECE = 1 << 20  # bytes of a blob copied at once
_INVALID = 2  # state of a point without coordinates
_COORDINATES = (
    *("cartesianX", "cartesianY", "cartesianZ"),
    *("sphericalRange", "sphericalAzimuth", "sphericalElevation"),
)
_STATES = ("cartesianInvalidState", "sphericalInvalidState")
_INDICES = ("rowIndex", "columnIndex")
_GROUPS = "pointGroupingSchemes"  # they number the points


def write_filtered(job: FilterJob) -> Omissions:
    """Copy a file or folder with points removed.

    Points of scans that are organised by rows and columns stay, and are marked as invalid.

    Raises:
        InputError: the source has changed since it was read, cannot be copied, or the output cannot
            be written.
    """
    files = files_of(job.source, E57_EXTENSIONS)
    return write_files(job, files, _filter_file, e57.count_scans(files, job.source.is_file()))


def _filter_file(path: Path, new: Path, masks: list[Mask | None]) -> None:
    with (
        e57.open_e57(path) as (library, source),
        _write_errors(path),
        closing(library.ImageFile(str(new), "w")) as target,
    ):
        copy = _TreeCopy(library, target, path, masks)
        for number in range(source.extensionsCount()):
            target.extensionsAdd(source.extensionsPrefix(number), source.extensionsUri(number))
        copy.copy_children(source.root(), target.root())
        for write in copy.payloads:
            write()


@contextmanager
def _write_errors(path: Path) -> Iterator[None]:
    """Turn errors of the library into those of a file that cannot be copied."""
    try:
        yield
    except (InputError, OSError, MemoryError):
        raise
    except Exception as error:
        what = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"cannot be written again: {what}", where=str(path)) from error


class _Field(NamedTuple):
    """A field of points: its path, the code of its type in NumPy, and the value that it has in an
    invalid point (None: any)."""

    name: str
    dtype: str
    value_of_invalid: float | None


@dataclass
class _TreeCopy:
    """Copies nodes to another file.

    Attributes:
        library: libe57.
        target: the file.
        path: of the source, for messages.
        masks: points to remove of each scan; None: leave the scan out.
        payloads: functions that write points and blobs once the nodes are attached.
    """

    library: Any
    target: Any
    path: Path
    masks: list[Mask | None]
    payloads: list[Callable[[], None]] = field(default_factory=list)

    def copy_children(self, source: Any, target: Any, omit: tuple[str, ...] = ()) -> None:
        """Copy the children of a structure into another one."""
        for number in range(source.childCount()):
            child = source.get(number)
            name = child.elementName()
            if name not in omit:
                is_scans = child.pathName() == "/data3D"
                target.set(name, self._copy_scans(child) if is_scans else self._copy(child))

    def _copy(self, node: Any) -> Any:
        """A copy of a node, not attached yet."""
        library, target = self.library, self.target
        kind, node = self._cast(node)
        if kind == "STRUCTURE":
            copy = library.StructureNode(target)
            self.copy_children(node, copy)
        elif kind == "VECTOR":
            copy = library.VectorNode(target, node.allowHeteroChildren())
            for number in range(node.childCount()):
                copy.append(self._copy(node.get(number)))
        elif kind == "COMPRESSED_VECTOR":
            copy = self._copy_table(node, None, False)
        elif kind == "BLOB":
            copy = library.BlobNode(target, node.byteCount())
            self.payloads.append(lambda: _copy_blob(node, copy))
        elif kind == "STRING":
            copy = library.StringNode(target, node.value())
        elif kind == "FLOAT":
            limits = node.minimum(), node.maximum()
            copy = library.FloatNode(target, node.value(), node.precision(), *limits)
        elif kind == "INTEGER":
            copy = library.IntegerNode(target, node.value(), node.minimum(), node.maximum())
        else:
            limits = node.minimum(), node.maximum()
            scaling = node.scale(), node.offset()
            copy = library.ScaledIntegerNode(target, node.rawValue(), *limits, *scaling)
        return copy

    def _cast(self, node: Any) -> tuple[str, Any]:
        """The kind of a node, and the node as that kind."""
        kinds = {
            "STRUCTURE": "StructureNode",
            "VECTOR": "VectorNode",
            "COMPRESSED_VECTOR": "CompressedVectorNode",
            "BLOB": "BlobNode",
            "STRING": "StringNode",
            "FLOAT": "FloatNode",
            "INTEGER": "IntegerNode",
            "SCALED_INTEGER": "ScaledIntegerNode",
        }
        kind = node.type().name.removeprefix("E57_")
        return kind, getattr(self.library, kinds[kind])(node)

    def _copy_scans(self, node: Any) -> Any:
        """A copy of the vector of scans, without points to remove."""
        scans = self._cast(node)[1]
        copy = self.library.VectorNode(self.target, scans.allowHeteroChildren())
        for number in range(scans.childCount()):
            mask = self.masks[number]
            if mask is not None:
                copy.append(self._copy_scan(self._cast(scans.get(number))[1], mask))
        return copy

    def _copy_scan(self, scan: Any, mask: Mask) -> Any:
        points = self._cast(scan.get("points"))[1]
        require_rows(mask, points.childCount(), self.path)
        columns = self.library.StructureNode(points.prototype())
        organised = scan.isDefined(_GROUPS) or any(columns.isDefined(name) for name in _INDICES)
        keep = organised and any(columns.isDefined(name) for name in _STATES)
        copy = self.library.StructureNode(self.target)
        omit = (_GROUPS,) if mask.any() and not keep else ()
        self.copy_children(scan, copy, (*omit, "points"))
        copy.set("points", self._copy_table(points, mask, keep))
        return copy

    def _copy_table(self, table: Any, mask: Mask | None, keep: bool) -> Any:
        """A copy of records; those of a mask are left out, or stay as invalid points."""
        prototype = self._copy(table.prototype())
        codecs = self.library.VectorNode(self.target, True)
        copy = self.library.CompressedVectorNode(self.target, prototype, codecs)
        removed = np.zeros(table.childCount(), np.bool_) if mask is None else mask
        fields = _list_fields(self.library, table.prototype(), self.path)
        self.payloads.append(lambda: self._copy_records(table, copy, fields, removed, keep))
        return copy

    def _copy_records(
        self, table: Any, copy: Any, fields: list[_Field], removed: Mask, keep: bool
    ) -> None:
        columns = [np.zeros(_BLOCK, one.dtype) for one in fields]
        kept = [np.zeros(_BLOCK, one.dtype) for one in fields]
        read = self._make_buffers(table.destImageFile(), fields, columns)
        write = self._make_buffers(self.target, fields, kept)
        with closing(table.reader(read)) as reader, closing(copy.writer(write)) as writer:
            first = 0
            while n := reader.read():
                gone = removed[first : first + n]
                rows = n if keep else n - int(np.count_nonzero(gone))
                for one, column, out in zip(fields, columns, kept, strict=True):
                    if keep:
                        fill = one.value_of_invalid
                        out[:n] = column[:n] if fill is None else np.where(gone, fill, column[:n])
                    else:
                        out[:rows] = column[:n][~gone]
                if rows:
                    writer.write(rows)
                first += n

    def _make_buffers(self, file: Any, fields: list[_Field], arrays: list[NDArray[Any]]) -> Any:
        buffers = self.library.VectorSourceDestBuffer()
        for one, array in zip(fields, arrays, strict=True):
            # neither converted nor scaled: values as they are stored
            buffers.append(
                self.library.SourceDestBuffer(file, one.name, array, _BLOCK, False, False)
            )
        return buffers


def _list_fields(library: Any, prototype: Any, path: Path) -> list[_Field]:
    """The fields of records.

    Raises:
        InputError: one is a text, which cannot be copied.
    """
    fields = []
    for node in _iter_leaves(library, prototype):
        kind, name = node.type().name.removeprefix("E57_"), node.pathName().removeprefix("/")
        if kind == "STRING":
            hint = "name=FORMAT writes its points in another format"
            raise InputError(
                "cannot be written again: its points have texts", where=str(path), hint=hint
            )
        if kind == "FLOAT":
            node = library.FloatNode(node)
            dtype = "f" if node.precision() == library.FloatPrecision.E57_SINGLE else "d"
        else:
            is_scaled = kind == "SCALED_INTEGER"
            node = library.ScaledIntegerNode(node) if is_scaled else library.IntegerNode(node)
            dtype = "q"
        fill = None
        if name in _STATES:
            fill = _INVALID
        elif name in _COORDINATES:
            fill = min(max(0, node.minimum()), node.maximum())
        fields.append(_Field(name, dtype, fill))
    return fields


def _iter_leaves(library: Any, node: Any) -> Iterator[Any]:
    if node.type().name != "E57_STRUCTURE":
        yield node
        return
    structure = library.StructureNode(node)
    for number in range(structure.childCount()):
        yield from _iter_leaves(library, structure.get(number))


def _copy_blob(source: Any, target: Any) -> None:
    size = source.byteCount()
    for start in range(0, size, _PIECE):
        piece = np.zeros(min(_PIECE, size - start), np.uint8)
        source.read(piece, start, len(piece))
        target.write(piece, start, len(piece))


def check(source: Path) -> None:
    """Refuse files whose points have texts, by their headers alone.

    Raises:
        InputError: there is one, or pye57 is missing.
    """
    import_extra("pye57.libe57", source)
    for path in files_of(source, E57_EXTENSIONS):
        for library, prototype in _read_prototypes(path):
            _list_fields(library, prototype, path)


def _read_prototypes(path: Path) -> Iterator[tuple[Any, Any]]:
    """libe57 and the prototype of the points of each scan; none of a damaged file."""
    with suppress(InputError), e57.open_e57(path) as (library, file):
        root = file.root()
        for scan in range(len(root["data3D"]) if root.isDefined("data3D") else 0):
            yield library, root["data3D"][scan]["points"].prototype()
