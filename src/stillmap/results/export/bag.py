"""Write a result as a ROS bag: scans with labels, map, trajectory, frames, moving objects."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from stillmap.core import se2
from stillmap.core.grid_map import limit_hits
from stillmap.io.ros import writer as ros
from stillmap.io.ros.messages import ODOMETRY, POINT_CLOUD, TF, BagKind
from stillmap.io.ros.writer import (
    BASE,
    MAP,
    ODOM,
    BagWriter,
    new_bag,
    require_stamps,
    write_sensor_frames,
)
from stillmap.results.export.bag_objects import make_object_writer
from stillmap.results.export.bag_scans import LaserWriter, LidarWriter, make_cloud_message
from stillmap.results.folder import Exported
from stillmap.results.point_cloud import cloud_from_recording

Progress = Callable[[float], None]

_LOCAL = "map_local"  # a frame near the robot, where the map frame begins far away
_MAX_POINTS = 1_000_000  # of the static cloud, which programs hold as one message


def write(
    result: Exported,
    path: Path,
    kind: BagKind,
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> list[str]:
    """Write a result as a ROS bag, scan by scan: memory is that of a few scans.

    In 2D `/scan` holds static and maximum-range beams, `/scan_dynamic` the dynamic ones; beams of
    the other topic are NaN. In 3D `/points` holds the returns of a sweep, deskewed, with
    `p_static`, and `/static_points` a sample of the static ones of all sweeps. Further topics:
    `/map`, `/trajectory`, `/objects` (markers), `/odom`, and transforms from map over odom and
    base_link to the sensors. Without odometry odom is map.

    Args:
        result: recording, poses, labels, map and tracks.
        path: a file, or the folder of kind "ros2".
        kind: of the bag.
        overwrite: replace an existing folder; a file is replaced in any case.
        progress: called with the share of the scans that is written.

    Returns:
        What the format cannot represent, a sentence each.

    Raises:
        InputError: the bag cannot be written or cannot hold the scans.
    """
    recording, stamps = result.recording, result.recording.stamp_ns.tolist()
    require_stamps(stamps[0], stamps[-1], kind)
    scans = LaserWriter(result) if recording.dimension == 2 else LidarWriter(result)
    with new_bag(path, kind, overwrite=overwrite) as bag:
        near = result.frame
        more = [(MAP, _LOCAL, near.to_map(np.eye(4)))] if near.is_shifted else []
        frames = write_sensor_frames(bag, recording, more)
        _write_latched_topics(bag, result)
        if isinstance(scans, LidarWriter):
            _write_static_points(bag, result, scans)
        scans.open(bag, frames)
        write_frames = _make_frame_writer(bag, result)
        write_objects = make_object_writer(bag, result.tracks, recording.stamp_ns)
        for t in recording.iter_scans(range(recording.n_scans), *scans.arrays):
            write_frames(t)
            scans.write(t)
            write_objects(t)
            if progress is not None:
                progress((t + 1) / recording.n_scans)
    return scans.describe_losses()


def _write_latched_topics(bag: BagWriter, result: Exported) -> None:
    """Map and trajectory, as one latched message each."""
    stamp_ns, grid = result.recording.stamp_ns, result.map
    first = int(stamp_ns[0])
    send = bag.add_topic("/map", ros.GRID, latched=True)
    corner = se2.matrix(*grid.origin)
    send(
        first,
        ros.make_occupancy_grid(bag, first, grid.p_occupied, corner, grid.resolution),
    )
    send = bag.add_topic("/trajectory", ros.PATH, latched=True)
    send(first, ros.make_path(bag, stamp_ns, result.poses))


def _write_static_points(bag: BagWriter, result: Exported, scans: LidarWriter) -> None:
    """At most `_MAX_POINTS` static points as one latched message, in a frame near the robot:
    programs expect coordinates of 32 bits."""
    near = result.frame
    seen = limit_hits(scans.deskewed, result.poses, result.region)
    cloud = cloud_from_recording(
        result.recording, seen, result.poses, result.p_static, "static", result.colors
    )
    first = int(result.recording.stamp_ns[0])
    send = bag.add_topic("/static_points", POINT_CLOUD, latched=True)
    block = cloud.sample(_MAX_POINTS)
    block = block._replace(points=near.points_to_local(block.points))
    frame = _LOCAL if near.is_shifted else MAP
    send(first, make_cloud_message(bag, first, frame, block))


def _make_frame_writer(bag: BagWriter, result: Exported) -> Callable[[int], None]:
    """A function that writes the frames, and the odometry, of a scan."""
    stamp_ns, T_odom_base = result.recording.stamp_ns, result.recording.T_odom_base
    send_tf = bag.add_topic("/tf", TF)
    send_odometry = None if T_odom_base is None else bag.add_topic("/odom", ODOMETRY)

    def write_frames(t: int) -> None:
        stamp, T_map_base = int(stamp_ns[t]), result.poses[t]
        T, T_map_odom = T_map_base, np.eye(len(T_map_base))
        if T_odom_base is not None:
            T = T_odom_base[t]
            T_map_odom = T_map_base @ se2.inverse(T)
        poses = [(MAP, ODOM, T_map_odom), (ODOM, BASE, T)]
        send_tf(stamp, ros.make_transforms(bag, stamp, poses))
        if send_odometry is not None:
            send_odometry(stamp, ros.make_odometry(bag, stamp, T))

    return write_frames
