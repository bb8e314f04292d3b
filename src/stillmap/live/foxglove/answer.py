"""A scan and its update as they are shown: as an object, and as arrays between processes."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.short_repr import ShortRepr
from stillmap.live.causal_labels import MapChange
from stillmap.live.messages import Arrays
from stillmap.live.movers import Mover
from stillmap.live.scan import ScanBeams
from stillmap.live.update import DOUBTS, Update

Float = NDArray[np.float64]


class Movers(NamedTuple):
    """K movers, as of `Mover`.

    Attributes:
        number: (K,).
        position: (K, D).
        velocity: (K, D).
        radius: (K,).
    """

    number: NDArray[np.int64]
    position: Float
    velocity: Float
    radius: Float


@dataclass(frozen=True, eq=False)
class Answer(ShortRepr):
    """A scan and the update that answered it.

    Attributes:
        stamp_ns: nanoseconds.
        sensor: name or number.
        points: (N, D) float32 end points in the sensor frame.
        hit: (N,) False where nothing was met.
        p_static: (N,) float32; NaN: unusable.
        T_map_base: (D+1, D+1).
        T_base_sensor: (D+1, D+1).
        T_map_odom: (D+1, D+1); None: without odometry.
        doubts: see Update.
        movers: what moves, in the map.
    """

    stamp_ns: int
    sensor: str | int
    points: NDArray[np.float32]
    hit: NDArray[np.bool_]
    p_static: NDArray[np.float32]
    T_map_base: Float
    T_base_sensor: Float
    T_map_odom: Float | None
    doubts: tuple[str, ...]
    movers: Movers


def to_answer(beams: ScanBeams, update: Update) -> Answer:
    """The scan and its update, without what is not shown."""
    return Answer(
        beams.stamp_ns,
        beams.sensor,
        beams.points,
        beams.hit,
        update.p_static,
        update.pose,
        beams.T_base_sensor,
        update.T_map_odom,
        update.doubts,
        _to_movers(update.movers, beams.dimension),
    )


def _to_movers(movers: list[Mover], dimension: int) -> Movers:
    position, velocity = (
        np.array([getattr(one, name) for one in movers]).reshape(-1, dimension)
        for name in ("position", "velocity")
    )
    number = np.array([one.number for one in movers], np.int64)
    return Movers(number, position, velocity, np.array([one.radius for one in movers]))


def pack_answer(answer: Answer) -> dict[str, NDArray[Any]]:
    """Arrays for `write_message`."""
    is_numbered = isinstance(answer.sensor, int)
    out = {
        "stamp_ns": np.array(answer.stamp_ns),
        "sensor": np.array(answer.sensor if is_numbered else -1),
        "sensor_name": np.frombuffer(str(answer.sensor).encode(), np.uint8),
        "points": answer.points,
        "hit": answer.hit,
        "p_static": answer.p_static,
        "T_map_base": answer.T_map_base,
        "T_base_sensor": answer.T_base_sensor,
        "doubts": np.array([name in answer.doubts for name in DOUBTS]),
    }
    out |= {f"movers.{name}": array for name, array in answer.movers._asdict().items()}
    if answer.T_map_odom is not None:
        out["T_map_odom"] = answer.T_map_odom
    return out


def unpack_answer(arrays: Arrays) -> Answer:
    """The answer of arrays from `pack_answer`."""
    number = int(arrays["sensor"])
    return Answer(
        int(arrays["stamp_ns"]),
        number if number >= 0 else arrays["sensor_name"].tobytes().decode(),
        arrays["points"],
        arrays["hit"],
        arrays["p_static"],
        arrays["T_map_base"],
        arrays["T_base_sensor"],
        arrays.get("T_map_odom"),
        tuple(name for name, is_so in zip(DOUBTS, arrays["doubts"], strict=True) if is_so),
        Movers(*(arrays[f"movers.{name}"] for name in Movers._fields)),
    )


def pack_changes(changes: list[MapChange], resolution: float) -> dict[str, NDArray[Any]]:
    """Arrays of at least one part of the map; resolution: m, edge of a cell."""
    return {
        "first_cell": np.stack([change.first_cell for change in changes]),
        "p_occupied": np.stack([change.p_occupied for change in changes]),
        "resolution": np.array(resolution),
    }


def unpack_changes(arrays: Arrays) -> list[MapChange]:
    """The parts of the map of arrays from `pack_changes`."""
    return list(map(MapChange, arrays["first_cell"], arrays["p_occupied"]))
