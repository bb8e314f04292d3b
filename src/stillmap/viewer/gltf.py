"""Models as they lie in a result: binary glTF files that hold all that they need."""

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.errors import InputError
from stillmap.texts import require_regular

# of the map frame, z up, where a model's y is up
MAP_FROM_GLTF: NDArray[np.float64] = np.array(
    [[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]]
)

_MAGIC, _JSON = b"glTF", b"JSON"
_HEAD = struct.Struct("<4sII")  # magic, version, length of all
_CHUNK = struct.Struct("<I4s")  # length, kind
_MOST_JSON = 64 << 20
# a browser would fetch what unpacks it from elsewhere
_PACKED = "KHR_draco_mesh_compression"


def require_whole(path: Path, most: int) -> bytes:
    """A .glb file of at most so many bytes that needs nothing from anywhere else.

    Raises:
        InputError: it is missing, too large, damaged, or names other files.
    """
    require_regular(path)
    if path.stat().st_size > most:
        raise InputError(f"is larger than {most >> 20} MiB", where=str(path))
    data = path.read_bytes()
    try:
        document = _document(data)
    except (ValueError, RecursionError, struct.error) as error:
        raise InputError(f"is no whole .glb file: {error}", where=str(path)) from error
    for uri in _addresses(document):
        if not (isinstance(uri, str) and uri.startswith("data:")):
            raise InputError("names another file: it is not shown", where=str(path))
    if _PACKED in document.get("extensionsUsed", []):
        raise InputError(f"uses {_PACKED}: it is not shown", where=str(path))
    return data


def _document(data: bytes) -> dict[str, Any]:
    magic, version, length = _HEAD.unpack_from(data)
    size, kind = _CHUNK.unpack_from(data, _HEAD.size)
    start = _HEAD.size + _CHUNK.size
    if magic != _MAGIC or version != 2 or length != len(data):
        raise ValueError("its header is that of something else")
    if kind != _JSON or size > min(len(data) - start, _MOST_JSON):
        raise ValueError("its first part is not what it is made of")
    document = json.loads(data[start : start + size].decode("utf-8"))
    if not isinstance(document, dict):
        raise ValueError("what it is made of is no object")
    return document


def _addresses(document: object) -> Iterator[object]:
    """Every `uri`, wherever it stands."""
    rest = [document]
    while rest:
        one = rest.pop()
        if isinstance(one, dict):
            rest.extend(one.values())
            if "uri" in one:
                yield one["uri"]
        elif isinstance(one, list):
            rest.extend(one)
