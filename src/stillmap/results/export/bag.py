"""Write a result as a ROS bag: scans with labels, map, trajectory, frames, moving objects."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Float, Int64
from stillmap.core.grid_map import limit_hits
from stillmap.core.local_frame import FAR, find_origin, shift_poses
from stillmap.core.recording import Recording
from stillmap.em.types import DYNAMIC_BELOW
from stillmap.io.ros import message_fields as ros
from stillmap.io.ros import writer
from stillmap.io.ros.message_fields import BASE, MAP, ODOM, Fields, LaserScanEncoder
from stillmap.io.ros.messages import LASER_SCAN, ODOMETRY, POINT_CLOUD, TF, BagKind
from stillmap.results import point_cloud
from stillmap.results.mapped_place import MappedPlace
from stillmap.results.objects import Mover, interpolate_pose, iter_present_tracks

Progress = Callable[[float], None]
ScanWriter = Callable[[int], None]

_LOCAL = "map_local"  # a frame near the robot, where the map frame begins far away
_MAX_POINTS = 1_000_000  # of the static cloud, which programs hold as one message
_BOX_COLOR = (0.9, 0.4, 0.0, 0.8)  # RGBA, the orange of the report
_TEXT_COLOR = (1.0, 1.0, 1.0, 1.0)  # RViz and Foxglove have a dark background
_HEIGHT, _MIN_SIZE = 0.5, 0.1  # m, of the boxes: height in 2D, least edge
_TEXT_HEIGHT, _TEXT_GAP = 0.3, 0.25  # m, of a letter, and above the box
_CUBE, _TEXT, _DELETE_ALL = 1, 9, 3  # of visualization_msgs/Marker


def write(
    result: MappedPlace,
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
    writer.require_stamps(stamps[0], stamps[-1], kind)
    encoder = LaserScanEncoder(recording) if recording.dimension == 2 else None
    seen = recording if recording.dimension == 2 else result.deskewed
    with writer.new_bag(path, kind, overwrite=overwrite) as bag:
        origin = find_origin(result.poses, FAR)  # sessions of a place state none of their own
        more = [(MAP, _LOCAL, shift_poses(np.eye(4), origin))] if origin.any() else []
        frames = writer.write_sensor_frames(bag, recording, more)
        _write_latched_topics(bag, result)
        if encoder is None:
            _write_static_points(bag, result, seen, origin)
            write_scan = _make_sweep_writer(bag, result, seen, frames)
        else:
            write_scan = _make_scan_writer(bag, result, encoder, frames)
        write_frames = _make_frame_writer(bag, result)
        write_objects = _make_object_writer(bag, result.objects, recording.stamp_ns)
        read = (seen.points, result.p_static, result.colors)
        arrays = [one for one in read if one is not None]
        for t in recording.iter_scans(range(recording.n_scans), *arrays):
            write_frames(t)
            write_scan(t)
            write_objects(t)
            if progress is not None:
                progress((t + 1) / recording.n_scans)
    return [] if encoder is None else encoder.describe_losses()


def _write_latched_topics(bag: writer.BagWriter, result: MappedPlace) -> None:
    """Map and trajectory, as one latched message each."""
    stamp_ns, grid = result.recording.stamp_ns, result.map
    first = int(stamp_ns[0])
    send = bag.add_topic("/map", writer.GRID, latched=True)
    corner = se2.matrix(*grid.origin)
    send(first, ros.make_occupancy_grid(first, grid.p_occupied, corner, grid.resolution))
    send = bag.add_topic("/trajectory", writer.PATH, latched=True)
    send(first, ros.make_path(stamp_ns, result.poses))


def _write_static_points(
    bag: writer.BagWriter, result: MappedPlace, deskewed: Recording, origin: Float
) -> None:
    """At most `_MAX_POINTS` static points as one latched message, in a frame near the robot:
    programs expect coordinates of 32 bits."""
    seen = limit_hits(deskewed, result.poses, result.loaded.output_options.region)
    cloud = point_cloud.cloud_from_recording(
        result.recording, seen, result.poses, result.p_static, "static", result.colors
    )
    first = int(result.recording.stamp_ns[0])
    send = bag.add_topic("/static_points", POINT_CLOUD, latched=True)
    block = cloud.sample(_MAX_POINTS)
    block = block._replace(points=block.points - origin)
    send(first, _make_cloud(first, _LOCAL if origin.any() else MAP, block))


def _make_cloud(stamp_ns: int, frame: str, block: point_cloud.Block) -> Fields:
    """A PointCloud2 of points in a frame: x, y, z, `p_static`, and `rgb` for colours."""
    colour = [] if block.colors is None else point_cloud.PACKED_COLOUR
    vertices = point_cloud.make_vertices(block, point_cloud.FIELDS + colour)
    return ros.make_point_cloud(stamp_ns, frame, vertices)


def _make_scan_writer(
    bag: writer.BagWriter, result: MappedPlace, encoder: LaserScanEncoder, frames: Sequence[str]
) -> ScanWriter:
    """A function that writes a scan to the static and the dynamic topic of its laser: in each the
    beams of the other one are NaN."""
    recording, p_static = result.recording, result.p_static
    names = [f"/{name}" for name in writer.number_names("scan", len(frames))]
    static = [bag.add_topic(name, LASER_SCAN) for name in names]
    dynamic = [bag.add_topic(f"{name}_dynamic", LASER_SCAN) for name in names]

    def write_scan(t: int) -> None:
        s, stamp = int(recording.sensor[t]), int(recording.stamp_ns[t])
        beams, ranges = recording.beams_of(t), encoder.ranges(t)
        is_dynamic = recording.hit[beams] & (p_static[beams] < DYNAMIC_BELOW)
        for sends, selected in ((static, ~is_dynamic), (dynamic, is_dynamic)):
            part = np.where(selected, ranges, np.float32(np.nan))
            sends[s](stamp, encoder.make_message(t, frames[s], part))

    return write_scan


def _make_sweep_writer(
    bag: writer.BagWriter, result: MappedPlace, deskewed: Recording, frames: Sequence[str]
) -> ScanWriter:
    """A function that writes the returns of a sweep in the frame of its lidar at the stamp."""
    names = writer.number_names("points", len(frames))
    sends = [bag.add_topic(f"/{name}", POINT_CLOUD) for name in names]

    def write_sweep(t: int) -> None:
        beams, s, stamp = deskewed.beams_of(t), int(deskewed.sensor[t]), int(deskewed.stamp_ns[t])
        hit = deskewed.hit[beams]
        colors = None if result.colors is None else result.colors[beams][hit]
        points = deskewed.points[beams][hit].astype(np.float64)
        block = point_cloud.Block(points, result.p_static[beams][hit], None, colors)
        sends[s](stamp, _make_cloud(stamp, frames[s], block))

    return write_sweep


def _make_frame_writer(bag: writer.BagWriter, result: MappedPlace) -> ScanWriter:
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
        send_tf(stamp, ros.make_transforms(stamp, poses))
        if send_odometry is not None:
            send_odometry(stamp, ros.make_odometry(stamp, T))

    return write_frames


def _make_object_writer(
    bag: writer.BagWriter, tracks: Sequence[Mover], stamp_ns: Int64
) -> ScanWriter:
    """A function that writes the markers at a scan; the scans (T,) come in order.

    Each message begins with a marker that removes the earlier ones.
    """
    send = bag.add_topic("/objects", writer.MARKERS)
    present_at, shown = iter_present_tracks(tracks, stamp_ns), list[int]()

    def write_markers(t: int) -> None:
        nonlocal shown
        before, shown = shown, next(present_at)
        if not before and not shown:
            return
        stamp = int(stamp_ns[t])
        markers = [_make_marker(stamp, action=_DELETE_ALL)]
        for n in shown:
            markers += _markers_of(stamp, tracks[n])
        send(stamp, {"markers": markers})

    return write_markers


def _markers_of(stamp: int, track: Mover) -> list[Fields]:
    """Box and number of an object at the interpolated pose of its track."""
    T = interpolate_pose(track, stamp)
    length, width, height = (max(edge, _MIN_SIZE) for edge in (*track.size, _HEIGHT)[:3])
    if track.z is None:
        T[2, 3] = height / 2
    above = np.eye(4)
    above[:3, 3] = T[:3, 3] + (0.0, 0.0, height / 2 + _TEXT_GAP)
    box = _make_marker(stamp, T, (length, width, height), id=track.id)
    number = _make_marker(
        stamp,
        above,
        (0.0, 0.0, _TEXT_HEIGHT),
        _TEXT_COLOR,
        ns="ids",
        type=_TEXT,
        id=track.id,
        text=str(track.id),
    )
    return [box, number]


def _make_marker(
    stamp: int,
    T: Float | None = None,
    size: tuple[float, ...] = (1.0, 1.0, 1.0),
    color: tuple[float, ...] = _BOX_COLOR,
    **more: Any,
) -> Fields:
    """A Marker at a pose (4, 4), a box unless other fields say otherwise."""
    header = ros.make_header(stamp, MAP)
    return {
        "header": header,
        "ns": "objects",
        "type": _CUBE,
        "pose": ros.make_pose(np.eye(4) if T is None else T),
        "scale": dict(zip("xyz", size, strict=True)),
        "color": dict(zip("rgba", color, strict=True)),
        "texture": {"header": {"stamp": header["stamp"]}},  # of ROS 2
        **more,
    }
