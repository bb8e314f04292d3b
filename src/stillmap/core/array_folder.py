"""Folders of flat arrays (`.npy`) and JSON: recordings, results, places and checkpoints are such.

A JSON file says what the folder is, in which `format_version`; it is written last. Folders are
written whole by `core.files.atomic_folder`.
"""

import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
from numpy.typing import DTypeLike, NDArray

from stillmap.core.arrays import empty, iter_blocks, write_npy
from stillmap.core.errors import InputError
from stillmap.core.input_files import InputFile
from stillmap.core.json import read_json, write_json

Model = TypeVar("Model")

FORMAT_VERSION = 1
_MAX_JSON = 256 << 20  # bytes


def write_arrays(
    folder: Path,
    arrays: Mapping[str, NDArray[Any] | None],
    name: str = "",
    record: Any = None,
) -> None:
    """Write arrays as NAME.npy, those that are None not, then the JSON file of the folder.

    Args:
        folder: an existing one.
        arrays: by name.
        name: of the JSON file; empty: none is written.
        record: its content, a mapping, to which `format_version` is added.
    """
    for key, array in arrays.items():
        if array is not None:
            write_npy(folder / f"{key}.npy", array)
    if name:
        write_json(folder / name, {"format_version": FORMAT_VERSION, **record})


def read_array(
    path: Path,
    shape: tuple[int | None, ...],
    dtype: DTypeLike,
    scratch: Path | None = None,
    grows: bool = False,
) -> NDArray[Any]:
    """The array of a file, of this shape (None: any length) and type; see `open_npy`.

    Raises:
        InputError: it is missing, damaged, or another one; where it grows, shorter.
    """
    array = open_npy(path, scratch, shape[0] if grows else None)
    sizes = zip(array.shape, shape, strict=True)
    fits = len(array.shape) == len(shape) and all(size in (None, given) for given, size in sizes)
    if not fits or array.dtype != np.dtype(dtype):
        target = f"({', '.join('any' if n is None else str(n) for n in shape)}) {np.dtype(dtype)}"
        what = f"is damaged: expected {target}, got {array.shape} {array.dtype}"
        raise InputError(what, where=str(path))
    return np.ascontiguousarray(array)


def read_poses(
    path: Path, count: int, D: int, largest: float, grows: bool = False
) -> NDArray[np.float64]:
    """(count, D+1, D+1) rigid transforms of a file, with translations of less than `largest` m.

    Raises:
        InputError: it is missing or damaged, or holds something else.
    """
    T = np.array(read_array(path, (count, D + 1, D + 1), np.float64, grows=grows))
    R = T[:, :D, :D]
    far = np.flatnonzero(~(np.abs(T) < largest).all(axis=(1, 2)))
    if len(far):
        what = f"is damaged: pose {far[0]} is not finite, or more than {largest:.0f} m away"
        raise InputError(what, where=str(path))
    is_rotation = np.allclose(R @ R.swapaxes(1, 2), np.eye(D), atol=1e-6)
    if not is_rotation or not np.all(T[:, D] == np.eye(D + 1)[D]):
        raise InputError("is damaged: not rigid transforms", where=str(path))
    return T


def read_probabilities(path: Path, count: int) -> NDArray[np.float32]:
    """(count,) float32 from 0 to 1, or NaN, memory-mapped where they are many.

    Raises:
        InputError: the file is missing or damaged, or holds something else.
    """
    p = read_array(path, (count,), np.float32)
    for block in iter_blocks(p):
        wrong = np.flatnonzero((p[block] < 0.0) | (p[block] > 1.0))
        if len(wrong):
            beam = block.start + int(wrong[0])
            raise InputError(f"beam {beam} has no probability in [0, 1]", where=str(path))
    return p


def read_record(path: Path, hint: str = "", max_bytes: int = _MAX_JSON) -> dict[str, Any]:
    """The JSON object of a folder that stillmap wrote.

    Raises:
        InputError: it is missing, damaged, or of another `format_version`.
    """
    record = read_json(path, max_bytes, hint)
    version = record.get("format_version") if isinstance(record, dict) else None
    if version != FORMAT_VERSION:
        what = f"format_version {version!r} is unknown here"
        raise InputError(what, where=str(path), hint=f"this version reads {FORMAT_VERSION}")
    return dict(record)


def parse(content: Any, kind: type[Model], path: Path, hint: str = "") -> Model:
    """JSON values as a dataclass or another type that msgspec knows.

    Raises:
        InputError: they are none; names the first entry at fault, of the file `path`.
    """
    try:
        return msgspec.convert(content, kind)
    except msgspec.ValidationError as error:
        raise InputError(f"is damaged: {error}", where=str(path), hint=hint) from error


def open_npy(path: Path, scratch: Path | None = None, rows: int | None = None) -> NDArray[Any]:
    """Read a `.npy` file: an array that cannot be written, memory-mapped where it is large.

    What is mapped is a copy, for the file may become shorter; see `core.input_files`.

    Args:
        path: the file.
        scratch: folder of the copy; None: the system's.
        rows: how many there are, of a file that still grows; None: as its header says.

    Raises:
        InputError: it is missing, damaged, or holds Python objects.
    """
    with InputFile(path) as file, _explain_damage(path):
        shape, is_fortran, dtype = _read_npy_header(file)
        if rows is not None:
            shape = (rows, *shape[1:])
        size = math.prod(shape) * dtype.itemsize
        if dtype.hasobject or size > file.size - file.tell():
            raise ValueError(f"no {shape} {dtype} follow its header")
        content = empty((size,), np.uint8, scratch)
        for block in iter_blocks(content):
            file.readinto(content[block].data)
        array = content.view(dtype).reshape(shape, order="F" if is_fortran else "C")
    array.flags.writeable = False
    return array


@contextmanager
def _explain_damage(path: Path, hint: str = "") -> Iterator[None]:
    """Turn whatever NumPy, zip and zlib make of damaged bytes into an InputError."""
    try:
        yield
    except InputError:
        raise
    except OSError as error:
        what = f"cannot be read: {error.strerror or error}"
        raise InputError(what, where=str(path), hint=hint) from error
    except Exception as error:
        raise InputError(f"is damaged: {error}", where=str(path), hint=hint) from error


def count_rows(path: Path) -> int:
    """Rows of a `.npy` file that still grows, by its size.

    Raises:
        InputError: it is missing or damaged.
    """
    with InputFile(path) as file, _explain_damage(path):
        shape, _, dtype = _read_npy_header(file)
        return (file.size - file.tell()) // (math.prod(shape[1:]) * dtype.itemsize)


def _read_npy_header(file: InputFile) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, whether columns come first, and dtype; never unpickles.

    Raises:
        Exception: in many ways where the bytes are damaged.
    """
    with warnings.catch_warnings():
        # on headers of Python 2, or damaged ones
        warnings.simplefilter("ignore")
        version = np.lib.format.read_magic(file)
        if version == (1, 0):
            return np.lib.format.read_array_header_1_0(file)
        if version == (2, 0):
            return np.lib.format.read_array_header_2_0(file)
    raise ValueError(f"version {version} of its header")


def read_npz(
    path: Path, names: Sequence[str] | None, max_bytes: int, hint: str = ""
) -> dict[str, NDArray[Any]]:
    """Arrays of an `.npz` file by name.

    Args:
        path: the file.
        names: of the arrays; None: all.
        max_bytes: of each when it is unpacked.
        hint: of the error about a damaged file.

    Raises:
        InputError: the file is missing or damaged, lacks an array, or one is too large.
    """
    with (
        InputFile(path) as file,
        _explain_damage(path, hint),
        np.load(file, allow_pickle=False) as archive,
    ):
        chosen = archive.files if names is None else names
        for name in chosen:
            size = archive.zip.getinfo(f"{name}.npy").file_size
            if size > max_bytes:
                what = f"is too large: {size >> 20} MiB of {name} when unpacked"
                raise InputError(what, where=str(path))
        return {name: np.asarray(archive[name]) for name in chosen}
