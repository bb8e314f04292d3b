"""The border of the computation: into a frame near the robot, and back into the map frame.

Given poses set the map frame, and so may the coordinates of clouds: it may begin anywhere on Earth.
"""

import dataclasses
from collections.abc import Iterable
from typing import NamedTuple, TypeVar

import numpy as np

from stillmap import em
from stillmap.core.array_types import Float, Int64
from stillmap.core.local_frame import LocalFrame
from stillmap.core.recording import Recording
from stillmap.em import GroundMap
from stillmap.io.point_cloud.origin import cloud_origin
from stillmap.mapping import Change, Door
from stillmap.pipeline.estimate import Estimate
from stillmap.pipeline.final_map import Maps
from stillmap.pipeline.snapshots import Snapshot
from stillmap.tracking import FlowMap, MovingObject

Object = TypeVar("Object", bound=MovingObject)


class LocalInputs(NamedTuple):
    """Recording and poses in a local frame near the robot.

    Attributes:
        frame: that frame.
        odometry: the frame of its odometry.
        recording: with odometry that begins near its own origin.
        poses: (T, D+1, D+1) in `frame`; None: to be estimated.
    """

    frame: LocalFrame
    odometry: LocalFrame
    recording: Recording
    poses: Float | None


def enter_local_frame(recording: Recording, poses: Float | None) -> LocalInputs:
    """A recording and poses to keep, in a frame near the robot; themselves where they are near.

    Args:
        recording: T scans.
        poses: (T, D+1, D+1) T_map_base; None: to be estimated. The map frame is then that of the
            first scan, or of the coordinates of its clouds before they were shifted in reading.
    """
    odometry, T_odom_base = LocalFrame(), recording.T_odom_base
    if T_odom_base is not None:  # of which only the increments count
        odometry = LocalFrame.near(T_odom_base)
        if odometry.is_shifted:
            near = odometry.to_local(T_odom_base)
            recording = dataclasses.replace(recording, T_odom_base=near)
    if poses is None:
        return LocalInputs(LocalFrame(cloud_origin(recording)), odometry, recording, None)
    frame = LocalFrame.near(poses)
    return LocalInputs(frame, odometry, recording, frame.to_local(poses))


def restore_odometry(recording: Recording, odometry: LocalFrame) -> Recording:
    """The recording with its odometry where it was before `enter_local_frame`."""
    if recording.T_odom_base is None or not odometry.is_shifted:
        return recording
    return dataclasses.replace(recording, T_odom_base=odometry.to_map(recording.T_odom_base))


def estimate_to_map(estimate: Estimate, frame: LocalFrame, cell: float) -> Estimate:
    """An estimate of a local frame in the map frame; its grid stays, and should be empty.

    Args:
        estimate: in `frame`.
        frame: the local frame.
        cell: metres, edge of the cells.
    """
    m_step, e_step = estimate.m_step, estimate.e_step
    graph = m_step.graph
    if graph is not None:
        graph = dataclasses.replace(graph, poses=frame.to_map(graph.poses))
    moved = dataclasses.replace(m_step, poses=frame.to_map(m_step.poses), graph=graph)
    occupied, no_return, changed = e_step.occupied, e_step.no_return, e_step.changed_cells
    by = np.round(frame.origin / cell).astype(np.int64)
    if occupied is not None:
        occupied = dataclasses.replace(occupied, cells=_add(occupied.cells, by))
    if no_return is not None:
        cells = _add(no_return.stop_cells, by)
        no_return = dataclasses.replace(no_return, stop_cells=cells)
    if changed is not None:
        changed = dataclasses.replace(changed, cells=_add(changed.cells, by))
    labels = dataclasses.replace(
        e_step,
        occupied=occupied,
        no_return=no_return,
        changed_cells=changed,
        ground=ground_to_map(e_step.ground, frame),
    )
    return dataclasses.replace(estimate, m_step=moved, e_step=labels)


def maps_to_map(maps: Maps, frame: LocalFrame) -> Maps:
    """The maps of a local frame in the map frame."""
    filtered, raw = (
        dataclasses.replace(one, origin=frame.corner_to_map(one.origin))
        for one in (maps.filtered, maps.raw)
    )
    ground = ground_to_map(maps.ground, frame)
    return dataclasses.replace(maps, filtered=filtered, raw=raw, ground=ground)


def ground_to_map(ground: GroundMap | None, frame: LocalFrame) -> GroundMap | None:
    """The ground of a local frame in the map frame."""
    if ground is None:
        return None
    height = ground.height + frame.origin[2]
    return dataclasses.replace(ground, height=height, corner=frame.points_to_map(ground.corner))


def snapshots_to_map(snapshots: Iterable[Snapshot], frame: LocalFrame) -> list[Snapshot]:
    """Snapshots of a local frame in the map frame."""
    return [
        dataclasses.replace(
            one,
            origin=frame.corner_to_map(one.origin),
            dynamic_points=frame.points_to_map(one.dynamic_points),
        )
        for one in snapshots
    ]


def objects_to_map(objects: Iterable[Object], frame: LocalFrame) -> list[Object]:
    """Moving objects of a local frame in the map frame."""
    by = frame.origin
    return [
        dataclasses.replace(one, xy=one.xy + by[:2], z=None if one.z is None else one.z + by[2])
        for one in objects
    ]


def traffic_to_map(traffic: FlowMap, frame: LocalFrame) -> FlowMap:
    """The flow map of a local frame in the map frame; one without squares has no place."""
    if not traffic.crossings.size:
        return traffic
    return dataclasses.replace(traffic, origin=frame.corner_to_map(traffic.origin))


def changes_to_map(
    changes: Iterable[Change], frame: LocalFrame, local_map: em.OccupancyMap
) -> list[Change]:
    """Changed places of a local frame in the map frame.

    Args:
        changes: in `frame`.
        frame: the local frame.
        local_map: the map in `frame`: cells of changes stay the same cells of it.
    """
    by = _cells_to_map(frame, local_map)
    return [
        dataclasses.replace(
            one,
            x=one.x + float(frame.origin[0]),
            y=one.y + float(frame.origin[1]),
            z=None if one.z is None else one.z + float(frame.origin[2]),
            cells=one.cells + by,
            door=None if one.door is None else _door_to_map(one.door, frame, by),
        )
        for one in changes
    ]


def doors_to_map(
    doors: Iterable[Door], frame: LocalFrame, local_map: em.OccupancyMap
) -> list[Door]:
    """Doors of a local frame in the map frame; arguments as of `changes_to_map`."""
    by = _cells_to_map(frame, local_map)
    return [_door_to_map(one, frame, by) for one in doors]


def _cells_to_map(frame: LocalFrame, local_map: em.OccupancyMap) -> Int64:
    """(2,) cells by which cells of a local frame are others in the map frame."""
    moved = dataclasses.replace(local_map, origin=frame.corner_to_map(local_map.origin))
    return np.asarray(moved.window.first_cell - local_map.window.first_cell)


def _door_to_map(door: Door, frame: LocalFrame, by: Int64) -> Door:
    x, y = (np.array(door.hinge) + frame.origin[:2]).tolist()
    return dataclasses.replace(
        door,
        hinge=(x, y),
        shut_cells=door.shut_cells + by,
        open_cells=door.open_cells + by,
        swept_cells=door.swept_cells + by,
    )


def _add(cells: Int64, by: Int64) -> Int64:
    return cells + by[: cells.shape[1]]
