"""What two runs must have in common for one to go on from the other."""

import hashlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.errors import InputError
from stillmap.options import to_dict
from stillmap.output.run_json import jsonable, version
from stillmap.pipeline import Options
from stillmap.recording.model import Recording
from stillmap.recording.spool import blocks

Float = NDArray[np.float64]
_NO_MATTER = ("threads",)  # options on which no byte of the result depends


def identity(recording: Recording, options: Options, poses: Float | None) -> dict[str, Any]:
    """What is mapped, and how, JSON-able: hashes of the arrays, whatever files they came from."""
    arrays: dict[str, NDArray[Any] | None] = {
        "stamps": recording.stamp_ns,
        "scans": recording.offset,
        "beams": recording.points,
        "returns": recording.hit,
        "times of beams": recording.beam_time,
        "places of sensors": recording.T_base_sensor,
        "sensors of scans": recording.sensor,
        "odometry": recording.T_odom_base,
        "given poses": poses,
    }
    chosen = {name: value for name, value in to_dict(options).items() if name not in _NO_MATTER}
    return {
        "version": version(),
        "options": jsonable(chosen),
        "arrays": {name: None if a is None else _hash(a) for name, a in arrays.items()},
    }


def require_same(before: dict[str, Any], now: dict[str, Any], where: str) -> None:
    """Refuse to go on from a run of something else.

    Raises:
        InputError: it names what differs.
    """
    if before == now:
        return
    differ = []
    if before["version"] != now["version"]:
        differ.append(f"version {before['version']} made it, this is {now['version']}")
    old, new = _flat(before["options"]), _flat(now["options"])
    for name in sorted(old.keys() | new.keys()):
        if old.get(name) != new.get(name):
            differ.append(f"{name} was {old.get(name)!r}, is {new.get(name)!r}")
    names = [name for name, a in now["arrays"].items() if before["arrays"].get(name) != a]
    if names:
        differ.append(f"another recording: {', '.join(names)} differ")
    raise InputError(
        f"cannot be resumed: {'; '.join(differ) or 'its description differs'}",
        where=where,
        hint="give the same as before, or start anew without --resume",
    )


def _hash(array: NDArray[Any]) -> str:
    found = hashlib.blake2b(f"{array.dtype.str} {array.shape}".encode(), digest_size=16)
    for block in blocks(array):
        found.update(np.ascontiguousarray(array[block]).reshape(-1).view(np.uint8).data)
    return found.hexdigest()


def _flat(options: dict[str, Any], section: str = "") -> dict[str, Any]:
    out: dict[str, Any] = {}
    for key, value in options.items():
        if isinstance(value, dict):
            out |= _flat(value, f"{section}{key}.")
        else:
            out[f"{section}{key}"] = value
    return out
