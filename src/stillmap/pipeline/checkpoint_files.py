"""The state of a run as JSON values and flat arrays, and back; what identifies a run."""

import dataclasses
import hashlib
import types
import typing
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap import em
from stillmap.core.arrays import iter_bytes
from stillmap.core.config import iter_options
from stillmap.core.errors import InputError
from stillmap.core.json import to_jsonable
from stillmap.core.recording import Recording
from stillmap.core.version import package_version
from stillmap.pipeline.estimate import EmState
from stillmap.pipeline.options import Options

Arrays = dict[str, NDArray[Any]]
Float = NDArray[np.float64]

_PLAIN = (bool, int, float, str)

_NO_MATTER = ("threads", "output.region")  # options on which no byte of a checkpoint depends


def pack_state(state: EmState) -> tuple[dict[str, Any], Arrays]:
    """JSON values and arrays by name; the labels of iteration k are the array "e-k"."""
    best, latest = state.require_best(), state.latest
    if latest is None:
        raise RuntimeError("no iteration has been run")
    labels = {
        id(latest.p_static): f"e-{latest.number}",
        id(best.p_static): f"e-{best.number}",
        id(best.weights): f"e-{best.number - 1}",
    }
    arrays: Arrays = {}
    values = {
        field.name: _pack(getattr(state, field.name), field.name, arrays, labels)
        for field in dataclasses.fields(state)
        if field.name != "options"
    }
    return values, arrays


def unpack_state(values: Mapping[str, Any], arrays: Mapping[str, Any], options: Options) -> EmState:
    """The state that `pack_state` was given."""
    hints = typing.get_type_hints(EmState)
    return EmState(options, **{n: _unpack(hints[n], value, arrays) for n, value in values.items()})


def _pack(value: Any, name: str, arrays: Arrays, labels: Mapping[int, str]) -> Any:
    """The JSON value of a tree of dataclasses; its arrays go into `arrays`."""
    if isinstance(value, np.ndarray):
        name = labels.get(id(value), name)
        arrays[name] = value
        return name
    if isinstance(value, em.Grid):  # always empty here
        return [2 if isinstance(value, _core.OccupancyGrid2D) else 3, value.resolution]
    if dataclasses.is_dataclass(value):
        return {
            field.name: _pack(getattr(value, field.name), f"{name}.{field.name}", arrays, labels)
            for field in dataclasses.fields(value)
        }
    if isinstance(value, list) and value and dataclasses.is_dataclass(value[0]):
        columns = {
            f.name: [getattr(one, f.name) for one in value] for f in dataclasses.fields(value[0])
        }
        return {
            key: _pack(
                np.stack(column) if isinstance(column[0], np.ndarray) else column,
                f"{name}.{key}",
                arrays,
                labels,
            )
            for key, column in columns.items()
        }
    if isinstance(value, dict) and any(map(dataclasses.is_dataclass, value.values())):
        return {key: _pack(one, f"{name}.{key}", arrays, labels) for key, one in value.items()}
    return value.item() if isinstance(value, np.generic) else value


def _unpack(hint: Any, value: Any, arrays: Mapping[str, Any]) -> Any:
    """The value of a type hint that `_pack` wrote."""
    if isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union:
        if value is None:
            return None
        if hint == em.Grid:
            return em.make_grid(*value)
        [hint] = (one for one in typing.get_args(hint) if one is not type(None))
    hint = _resolve_alias(hint)
    origin, parameters = typing.get_origin(hint), typing.get_args(hint)
    if origin is np.ndarray:
        return _array_of(hint, arrays[value], value)
    if origin is tuple:
        kinds = typing.get_args(hint)
        return tuple(_unpack(k, one, arrays) for k, one in zip(kinds, value, strict=True))
    if origin is list and dataclasses.is_dataclass(parameters[0]):
        return _unpack_list(parameters[0], value, arrays)
    if origin is dict and dataclasses.is_dataclass(parameters[1]):
        return {
            parameters[0](key): _unpack(parameters[1], one, arrays) for key, one in value.items()
        }
    if dataclasses.is_dataclass(hint):
        hints = _hints(hint)
        return hint(**{n: _unpack(hints[n], one, arrays) for n, one in value.items()})  # type: ignore[operator]
    if origin is list:
        return [_unpack(parameters[0], one, arrays) for one in _typed(value, list)]
    if hasattr(hint, "_fields"):  # a NamedTuple, of which JSON makes a list
        return hint(
            *(
                _unpack(kind, one, arrays)
                for kind, one in zip(typing.get_type_hints(hint).values(), value, strict=True)
            )
        )
    return _typed(value, hint)


def _resolve_alias(hint: Any) -> Any:
    """The type that an alias with parameters names; `NDArray` is an alias since NumPy 2.5."""
    alias = typing.get_origin(hint)
    return alias.__value__[typing.get_args(hint)] if hasattr(alias, "__value__") else hint


def _array_of(hint: Any, array: NDArray[Any], name: str) -> NDArray[Any]:
    """The array, of the elements that its type hint names."""
    wanted = typing.get_args(typing.get_args(_resolve_alias(hint))[1])[0]
    # by its size: C has two integer types of 64 bits, which NumPy tells apart
    if not np.issubdtype(np.dtype(array.dtype.str), wanted):
        raise TypeError(f"{name} holds {array.dtype}")
    return array


def _typed(value: Any, kind: Any) -> Any:
    """A value of JSON, of the type of its hint.

    Raises:
        TypeError: it is another one, or an integer of more than 64 bits.
    """
    if kind is float and type(value) in (int, float):
        return float(value)
    if kind is int and type(value) is int and abs(value) < 2**63:
        return value
    if (kind in (bool, str, list) and type(value) is kind) or kind not in (*_PLAIN, list):
        return value
    raise TypeError(f"{value!r} is no {kind.__name__}")


def _unpack_list(kind: Any, columns: Any, arrays: Mapping[str, Any]) -> list[Any]:
    if not columns:
        return []
    hints = _hints(kind)
    of_rows = [arrays[column] if isinstance(column, str) else column for column in columns.values()]
    return [
        kind(
            **{
                n: (
                    _array_of(hints[n], value, n)
                    if isinstance(value, np.ndarray)
                    else _unpack(hints[n], value, arrays)
                )
                for n, value in zip(columns, row, strict=True)
            }
        )
        for row in zip(*of_rows, strict=True)
    ]


def _hints(kind: Any) -> dict[str, Any]:
    return typing.get_type_hints(kind, localns={"GroundMap": em.GroundMap})


def identify_run(recording: Recording, options: Options, poses: Float | None) -> dict[str, Any]:
    """Identifies a run by its version, options and hashes of the input arrays, as JSON values."""
    arrays: dict[str, NDArray[Any] | None] = {
        "stamps": recording.stamp_ns,
        "scans": recording.offset,
        "beams": recording.points,
        "returns": recording.hit,
        "beam times": recording.beam_time,
        "sensor poses": recording.T_base_sensor,
        "sensors of scans": recording.sensor,
        "odometry": recording.T_odom_base,
        "given poses": poses,
    }
    return {
        "version": package_version(),
        "options": {
            one.name: to_jsonable(one.value)
            for one in iter_options(options)
            if one.name not in _NO_MATTER
        },
        "arrays": {name: None if a is None else _hash(a) for name, a in arrays.items()},
    }


def require_same_run(before: dict[str, Any], now: dict[str, Any], where: str) -> None:
    """Refuses to continue the run of something else.

    Raises:
        InputError: it names what differs.
    """
    if before == now:
        return
    differ = []
    if before["version"] != now["version"]:
        differ.append(f"version {before['version']} made it, this is {now['version']}")
    old, new = before["options"], now["options"]
    for name in sorted(old.keys() | new.keys()):
        if old.get(name) != new.get(name):
            differ.append(f"{name} was {old.get(name)!r}, is {new.get(name)!r}")
    names = [name for name, a in now["arrays"].items() if before["arrays"].get(name) != a]
    if names:
        differ.append(f"another recording: {', '.join(names)} differ")
    raise InputError(
        f"cannot be resumed: {'; '.join(differ) or 'its description differs'}",
        where=where,
        hint="give the same as before, or start anew without resume=True",
    )


def _hash(array: NDArray[Any]) -> str:
    found = hashlib.blake2b(f"{array.dtype.str} {array.shape}".encode(), digest_size=16)
    for part in iter_bytes(array):
        found.update(part)
    return found.hexdigest()
