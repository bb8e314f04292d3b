"""The border of the computation: into a frame near the robot, and back into the map frame.

Given poses set the map frame, and so may the coordinates of clouds: it may begin anywhere on Earth.
"""

import dataclasses
from typing import Any, NamedTuple, TypeVar

import numpy as np

from stillmap import em, slam
from stillmap.core.array_types import Float, Int64
from stillmap.core.local_frame import LocalFrame
from stillmap.core.recording import Recording
from stillmap.em.types import CellProbabilities, ChangedCells, NoReturnModel
from stillmap.io.point_cloud.clouds import cloud_origin
from stillmap.mapping import Change, Door
from stillmap.pipeline.em_loop import Estimate
from stillmap.pipeline.final_map import Maps
from stillmap.pipeline.snapshots import Snapshot
from stillmap.pipeline.tilting import TiltingResult
from stillmap.tracking import FlowMap, MovingObject
from stillmap.tracking.boxes import Box

Value = TypeVar("Value")


def enter_local_frame(
    recording: Recording, poses: Float | None
) -> tuple[LocalFrame, LocalFrame, Recording, Float | None]:
    """A recording and poses to keep, in a frame near the robot; themselves where they are near.

    Args:
        recording: T scans.
        poses: (T, D+1, D+1) T_map_base; None: to be estimated. The map frame is then that of the
            first scan, or of the coordinates of its clouds before they were shifted in reading.

    Returns:
        the frame; that of the odometry, of which only the increments count; the recording with
        odometry in it; the poses in the frame.
    """
    odometry = LocalFrame()
    if recording.T_odom_base is not None:
        odometry = LocalFrame.near(recording.T_odom_base)
        recording = move_odometry(recording, -odometry.origin)
    if poses is None:
        return LocalFrame(cloud_origin(recording)), odometry, recording, None
    frame = LocalFrame.near(poses)
    return frame, odometry, recording, frame.to_local(poses)


def move_odometry(recording: Recording, by: Float) -> Recording:
    """The recording with its odometry (3,) metres farther; itself where that is nothing."""
    if recording.T_odom_base is None or not by.any():
        return recording
    return dataclasses.replace(recording, T_odom_base=_move_poses(recording.T_odom_base, by))


class Shift(NamedTuple):
    """The way from a frame to another one with the same axes.

    Attributes:
        metres: (3,).
        cells: (3,) by which cells that count from its origin are others.
        map_cells: (2,) the same of cells of the map.
    """

    metres: Float
    cells: Int64 = np.zeros(3, np.int64)
    map_cells: Int64 = np.zeros(2, np.int64)

    @classmethod
    def of(cls, frame: LocalFrame, local_map: em.OccupancyMap) -> "Shift":
        """From a local frame to the map frame; `local_map`: the map in the former."""
        cells = np.round(frame.origin / local_map.resolution).astype(np.int64)
        moved = dataclasses.replace(local_map, origin=frame.corner_to_map(local_map.origin))
        return cls(frame.origin, cells, moved.window.first_cell - local_map.window.first_cell)


def _move_poses(poses: Float, by: Float) -> Float:
    moved, dimension = poses.copy(), poses.shape[-1] - 1
    moved[..., :dimension, dimension] += by[:dimension]
    return moved


def shift(value: Value, by: Shift) -> Value:
    """A result or a part of one, or each of a list of parts, in another frame; None stays None."""
    if isinstance(value, list):
        return [shift(one, by) for one in value]  # type: ignore[return-value]
    is_nowhere = isinstance(value, FlowMap) and not value.crossings.size
    kind = next((kind for kind in type(value).__mro__ if kind in _FIELDS), None)
    if kind is None or is_nowhere:
        return value
    fields = {name: (how, getattr(value, name)) for name, how in _FIELDS[kind].items()}
    moved = {name: _move(old, how, by) for name, (how, old) in fields.items() if old is not None}
    return dataclasses.replace(value, **moved)  # type: ignore[type-var]


def _move(value: Any, how: str, by: Shift) -> Any:
    """The value of a field in another frame; `how`: what it is, see `_FIELDS`."""
    x, y, z = by.metres.tolist()
    match how:
        case "part":
            return shift(value, by)
        case "poses":
            return _move_poses(value, by.metres)
        case "points":
            return np.asarray(value, np.float64) + by.metres[: np.shape(value)[-1]]
        case "corner":
            return value[0] + x, value[1] + y, *value[2:]
        case "cells":
            return value + by.cells[: value.shape[1]]
        case "map cells":
            return value + by.map_cells
    return value + {"x": x, "y": y, "z": z}[how]


# fields that depend on the frame
_FIELDS: dict[type, dict[str, str]] = {
    Estimate: {"m_step": "part", "e_step": "part"},
    slam.MStepResult: {"poses": "poses", "graph": "part"},
    slam.PoseGraph: {"poses": "poses"},
    em.EStepResult: dict.fromkeys(("occupied", "no_return", "changed_cells", "ground"), "part"),
    CellProbabilities: {"cells": "cells"},
    NoReturnModel: {"stop_cells": "cells"},
    ChangedCells: {"cells": "cells"},
    em.GroundMap: {"height": "z", "corner": "points"},
    Maps: {"filtered": "part", "raw": "part", "ground": "part"},
    em.OccupancyMap: {"origin": "corner"},
    Snapshot: {"origin": "corner", "dynamic_points": "points"},
    FlowMap: {"origin": "corner"},
    MovingObject: {"xy": "points", "z": "z"},
    Change: {"x": "x", "y": "y", "z": "z", "cells": "map cells", "door": "part"},
    Door: {
        "hinge": "corner",
        **dict.fromkeys(("shut_cells", "open_cells", "swept_cells"), "map cells"),
    },
    TiltingResult: {"poses": "poses", "objects": "part", "boxes": "part"},
    Box: {"xy": "points"},
}
