"""Reading of `.npy` and `.npz` files."""

import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import empty, iter_blocks
from stillmap.core.errors import InputError
from stillmap.core.input_files import InputFile


def open_npy(path: Path, scratch: Path | None = None) -> NDArray[Any]:
    """Read a `.npy` file: an array that cannot be written, memory-mapped where it is large.

    What is mapped is a copy, for the file may become shorter; see `core.input_files`.

    Args:
        path: the file.
        scratch: folder of the copy; None: the system's.

    Raises:
        InputError: it is missing, damaged, or holds Python objects.
    """
    with InputFile(path) as file:
        try:
            shape, is_fortran, dtype = _read_npy_header(file)
            size = math.prod(shape) * dtype.itemsize
            if dtype.hasobject or size > file.size - file.tell():
                raise ValueError(f"no {shape} {dtype} follow its header")
            content = empty((size,), np.uint8, scratch)
            for block in iter_blocks(content):
                file.readinto(content[block].data)
            array = content.view(dtype).reshape(shape, order="F" if is_fortran else "C")
        except InputError:
            raise
        except OSError as error:
            what = f"cannot be read: {error.strerror or error}"
            raise InputError(what, where=str(path)) from error
        except Exception as error:  # the header parser fails in many ways
            raise InputError(f"is damaged: {error}", where=str(path)) from error
    array.flags.writeable = False
    return array


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
    with InputFile(path) as file:
        try:
            with np.load(file, allow_pickle=False) as archive:
                wanted = archive.files if names is None else names
                for name in wanted:
                    size = archive.zip.getinfo(f"{name}.npy").file_size
                    if size > max_bytes:
                        what = f"is too large: {size >> 20} MiB of {name} when unpacked"
                        raise InputError(what, where=str(path))
                return {name: np.asarray(archive[name]) for name in wanted}
        except InputError:
            raise
        except Exception as error:  # whatever NumPy, zip and zlib make of damaged bytes
            raise InputError(f"is damaged: {error}", where=str(path), hint=hint) from error
