"""A frame near the robot, for poses in a map projection or another frame that begins far away.

Grids number their cells from the origin, a million along an axis, and 32-bit floats resolve a
millimetre no farther than 10 km from it. What is computed with either therefore happens in a local
frame, whose axes are those of the map frame and whose origin is close: it is subtracted where poses
enter, and added to what leaves. Nothing in between knows of it.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple, TypeVar

import numpy as np

from stillmap.core.array_types import Float, Int64

Value = TypeVar("Value")
# of a type, its fields that depend on the frame, and what each is: see `_shift_field`
Fields = Mapping[type, Mapping[str, str]]

FAR = 1e4  # m, from which on 32-bit floats are too coarse for coordinates


def find_origin(poses: Float, min_distance: float = 0.0) -> Float:
    """(3,) origin of a local frame of poses (T, D+1, D+1); 0: most are within `min_distance`, m.

    The first pose that is near most of the others, so that the same robot elsewhere sees the same
    cells: a receiver may state zeros until it knows where it is.
    """
    dimension = poses.shape[-1] - 1
    origin, positions = np.zeros(3), poses[:, :dimension, dimension]
    positions = positions[np.isfinite(positions).all(axis=1)]
    if len(positions):
        middle = np.median(positions, axis=0)
        if np.abs(middle).max() >= min_distance:
            apart = np.abs(positions - middle).max(axis=1)
            first = np.argmax(apart <= max(FAR, float(np.median(apart))))
            origin[:dimension] = positions[first]
    return origin


class Shift(NamedTuple):
    """The way from a frame to another one with the same axes.

    Attributes:
        metres: (3,).
        cells: (3,) by which cells that count from its origin are others.
    """

    metres: Float
    cells: Int64 = np.zeros(3, np.int64)

    @classmethod
    def of(cls, metres: Float, resolution: float) -> "Shift":
        """The shift by so many metres; `resolution`: edge of the cells."""
        return cls(metres, np.round(metres / resolution).astype(np.int64))


def shift_poses(poses: Float, metres: Float) -> Float:
    """Poses (..., D+1, D+1) that many metres (3,) farther; themselves where that is nothing."""
    if not metres.any():
        return poses
    moved, dimension = np.array(poses), poses.shape[-1] - 1
    moved[..., :dimension, dimension] += metres[:dimension]
    return moved


def shift(value: Value, by: Shift, fields: Fields) -> Value:
    """A value, or each of a list, in another frame; itself where that is the same.

    Args:
        value: None, or what has no fields that depend on the frame, stays as it is.
        by: the way to the other frame.
        fields: of its type and of those of its parts.
    """
    if isinstance(value, list):
        return [shift(one, by, fields) for one in value]  # type: ignore[return-value]
    kind = next((kind for kind in type(value).__mro__ if kind in fields), None)
    if kind is None or not by.metres.any():
        return value
    old = {name: (how, getattr(value, name)) for name, how in fields[kind].items()}
    moved = {
        name: _shift_field(field, how, by, fields)
        for name, (how, field) in old.items()
        if field is not None
    }
    return dataclasses.replace(value, **moved)  # type: ignore[type-var]


def _shift_field(value: Any, how: str, by: Shift, fields: Fields) -> Any:
    """The value of a field in another frame."""
    x, y, z = by.metres.tolist()
    match how:
        case "part":
            return shift(value, by, fields)
        case "poses":
            return shift_poses(value, by.metres)
        case "view":  # a pose of the frame in another one
            return value @ shift_poses(np.eye(4), -by.metres)
        case "points":
            return np.asarray(value, np.float64) + by.metres[: np.shape(value)[-1]]
        case "corner":
            return value[0] + x, value[1] + y, *value[2:]
        case "cells":
            return value + by.cells[: np.shape(value)[-1]]
    return value + {"x": x, "y": y, "z": z}[how]
