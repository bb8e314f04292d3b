"""Arrays between our own processes: a length, a header in JSON, the bytes of the arrays."""

import json
import struct
from collections.abc import Mapping
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

Arrays = Mapping[str, NDArray[Any]]

_LENGTH = struct.Struct("<Q")
_MAX_HEADER = 1 << 26  # bytes: a correction in a large hall has thousands of scans


def write_message(stream: IO[bytes], arrays: Arrays) -> None:
    """Write named arrays of numbers and flush."""
    plain = {name: np.asarray(array, order="C") for name, array in arrays.items()}
    fields = [[name, a.dtype.str, list(a.shape)] for name, a in plain.items()]
    header = json.dumps(fields).encode()
    stream.write(_LENGTH.pack(len(header)) + header)
    for array in plain.values():
        stream.write(array.reshape(-1).view(np.uint8).data)
    stream.flush()


def read_message(stream: IO[bytes]) -> dict[str, NDArray[Any]] | None:
    """Read named arrays; None: the stream has ended, perhaps amid a message.

    Raises:
        ValueError: these are no arrays.
    """
    start = stream.read(_LENGTH.size)
    if len(start) < _LENGTH.size:
        return None
    (length,) = _LENGTH.unpack(start)
    if length > _MAX_HEADER:
        raise ValueError(f"header: expected at most {_MAX_HEADER} bytes, got {length}")
    header = stream.read(length)
    if len(header) < length:
        return None
    out = {}
    for name, dtype, shape in json.loads(header):
        kind = np.dtype(dtype)
        if kind.hasobject:
            raise ValueError(f"{name}: expected numbers")
        size = int(np.prod(shape, dtype=np.int64)) * kind.itemsize
        data = stream.read(size)
        if len(data) < size:
            return None
        out[name] = np.frombuffer(data, kind).reshape(shape)
    return out
