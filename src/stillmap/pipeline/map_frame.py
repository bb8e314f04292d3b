"""The border of the computation: into a frame near the robot, and back into the map frame.

Given poses set the map frame, and so may the coordinates of clouds: it may begin anywhere on Earth.
"""

import dataclasses
from types import MappingProxyType
from typing import TypeVar

import numpy as np

from stillmap import em, slam
from stillmap.core.array_types import Float
from stillmap.core.grid_map import GridMap
from stillmap.core.local_frame import FAR, Fields, Shift, find_origin, shift, shift_poses
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

Result = TypeVar("Result")


def enter_local_frame(
    recording: Recording, poses: Float | None, origin: Float | None = None
) -> tuple[Float, Float, Recording, Float | None]:
    """A recording and poses to keep, in a frame that begins near the robot: at its first pose.

    Args:
        recording: T scans.
        poses: (T, D+1, D+1) T_map_base; None: to be estimated. The map frame is then that of the
            first scan, or of the coordinates of its clouds before they were shifted in reading.
        origin: (3,) of the frame, with poses; None: their first one.

    Returns:
        the origin (3,) of the frame; that of the odometry, of which only the increments count; the
        recording with odometry in it; the poses in the frame.
    """
    odometry = np.zeros(3)
    if recording.T_odom_base is not None:
        odometry = find_origin(recording.T_odom_base, FAR)
        recording = move_odometry(recording, -odometry)
    if poses is None:
        return cloud_origin(recording), odometry, recording, None
    origin = find_origin(poses) if origin is None else origin
    return origin, odometry, recording, shift_poses(poses, -origin)


def move_odometry(recording: Recording, metres: Float) -> Recording:
    """The recording with its odometry that many metres (3,) farther; itself where it is 0."""
    if recording.T_odom_base is None or not metres.any():
        return recording
    return dataclasses.replace(recording, T_odom_base=shift_poses(recording.T_odom_base, metres))


# fields that depend on the frame
FIELDS: Fields = {
    Estimate: {"m_step": "part", "e_step": "part"},
    slam.MStepResult: {"poses": "poses", "graph": "part"},
    slam.PoseGraph: {"poses": "poses"},
    em.EStepResult: dict.fromkeys(("occupied", "no_return", "changed_cells", "ground"), "part"),
    CellProbabilities: {"cells": "cells"},
    NoReturnModel: {"stop_cells": "cells"},
    ChangedCells: {"cells": "cells"},
    em.GroundMap: {"height": "z", "corner": "points"},
    Maps: {"filtered": "part", "raw": "part", "ground": "part"},
    GridMap: {"origin": "corner"},
    Snapshot: {"origin": "corner", "dynamic_points": "points"},
    FlowMap: {"origin": "corner"},
    MovingObject: {"xy": "points", "z": "z"},
    Change: {"x": "x", "y": "y", "z": "z", "cells": "cells", "door": "part"},
    Door: {
        "hinge": "corner",
        **dict.fromkeys(("shut_cells", "open_cells", "swept_cells"), "cells"),
    },
    TiltingResult: {"poses": "poses", "objects": "part", "boxes": "part"},
    Box: {"xy": "points"},
}


def leave_local_frame(
    result: Result,
    origin: Float,
    local_map: em.OccupancyMap | None = None,
    fields: Fields = MappingProxyType({}),
) -> Result:
    """A result that was computed in a local frame, in the map frame, with itself as `local`.

    Args:
        result: a dataclass; itself where both frames are the same.
        origin: (3,) of the local frame.
        local_map: the map in it, by whose corner cells are rounded; None: there are no cells.
        fields: of the result, beside `FIELDS`.
    """
    by = Shift(origin)
    if local_map is not None:
        by = Shift.of(origin, local_map.resolution)
        moved_map = shift(local_map, by, FIELDS)
        by.cells[:2] = moved_map.window.first_cell - local_map.window.first_cell
    moved = shift(result, by, {**FIELDS, **fields})
    return result if moved is result else dataclasses.replace(moved, local=result)  # type: ignore[type-var]
