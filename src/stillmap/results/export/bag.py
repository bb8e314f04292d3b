"""Write a result as a ROS bag: static and dynamic scans, map, trajectory, moving objects."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.em.types import DYNAMIC_BELOW
from stillmap.io.ros import message_writer
from stillmap.io.ros.bag_types import BagKind
from stillmap.io.ros.bag_writer import BagWriter, new_bag, require_stamps
from stillmap.io.ros.message_writer import BASE, MAP
from stillmap.io.ros.messages import LASER_SCAN, TF
from stillmap.io.ros.recording_writer import LaserScanEncoder, number_names, write_sensor_frames
from stillmap.results.folder import Exported
from stillmap.results.reader import Track

_COLOR = (0.9, 0.4, 0.0, 0.8)  # RGBA, the orange of the report
_HEIGHT, _MIN_SIZE = 0.5, 0.1  # m, of the boxes
_CUBE, _ADD, _DELETE_ALL = 1, 0, 3  # of visualization_msgs/Marker


def write(result: Exported, path: Path, kind: BagKind, *, overwrite: bool = False) -> list[str]:
    """Write a result as a ROS bag.

    `/scan` holds static and maximum-range beams, `/scan_dynamic` the dynamic ones; beams of the
    other topic are NaN. Further topics: `/map`, `/trajectory`, `/objects` (markers), and
    transforms from map over base_link to the lasers.

    Returns:
        What the format cannot represent, a sentence each.

    Raises:
        InputError: the bag cannot be written or cannot hold the scans.
    """
    recording, stamps = result.recording, result.recording.stamp_ns.tolist()
    require_stamps(stamps[0], stamps[-1], kind)
    lasers = LaserScanEncoder(recording)
    with new_bag(path, kind, overwrite=overwrite) as bag:
        frames = write_sensor_frames(bag, recording)
        _write_latched_topics(bag, result)
        names = [f"/{name}" for name in number_names("scan", len(frames))]
        static = [bag.add_topic(name, LASER_SCAN) for name in names]
        dynamic = [bag.add_topic(f"{name}_dynamic", LASER_SCAN) for name in names]
        send_tf = bag.add_topic("/tf", TF)
        write_objects = _make_object_writer(bag, result)
        for t in recording.iter_scans(range(recording.n_scans), result.p_static):
            stamp = stamps[t]
            send_tf(
                stamp, message_writer.make_transforms(bag, stamp, [(MAP, BASE, result.poses[t])])
            )
            s = int(recording.sensor[t])
            beams, ranges = recording.beams_of(t), lasers.ranges(t)
            is_dynamic = recording.hit[beams] & (result.p_static[beams] < DYNAMIC_BELOW)
            for sends, selected in ((static, ~is_dynamic), (dynamic, is_dynamic)):
                part = np.where(selected, ranges, np.float32(np.nan))
                sends[s](stamp, lasers.make_message(bag, t, frames[s], part))
            write_objects(t)
    return lasers.describe_losses()


def _write_latched_topics(bag: BagWriter, result: Exported) -> None:
    """Map and trajectory, as one latched message each."""
    stamp_ns, grid = result.recording.stamp_ns, result.map
    first = int(stamp_ns[0])
    send = bag.add_topic("/map", message_writer.GRID, latched=True)
    corner = se2.matrix(*grid.origin)
    send(
        first,
        message_writer.make_occupancy_grid(bag, first, grid.p_occupied, corner, grid.resolution),
    )
    send = bag.add_topic("/trajectory", message_writer.PATH, latched=True)
    send(first, message_writer.make_path(bag, stamp_ns, result.poses))


def _make_object_writer(bag: BagWriter, result: Exported) -> Callable[[int], None]:
    """A function that writes the markers of all objects at a scan."""
    send = bag.add_topic("/objects", message_writer.MARKERS)
    stamp_ns = result.recording.stamp_ns
    first = [int(np.searchsorted(stamp_ns, one.stamp_ns[0])) for one in result.tracks]
    last = [int(np.searchsorted(stamp_ns, one.stamp_ns[-1], "right")) for one in result.tracks]
    starting: dict[int, list[int]] = {}
    for number, scan in enumerate(first):
        starting.setdefault(scan, []).append(number)
    shown: list[int] = []

    def write_markers(t: int) -> None:
        nonlocal shown
        before, stamp = shown, int(stamp_ns[t])
        shown = [n for n in (*shown, *starting.get(t, ())) if last[n] > t]
        if not before and not shown:
            return
        markers = [_marker(bag, stamp, _DELETE_ALL)]
        markers += [_box(bag, stamp, result.tracks[n]) for n in shown]
        send(stamp, bag.make(message_writer.MARKERS, markers=markers))

    return write_markers


def _box(bag: BagWriter, stamp: int, one: Track) -> Any:
    """The box of an object at the interpolated position of its track."""
    seconds = 1e-9 * (one.stamp_ns - stamp)
    x, y, vx, vy = (np.interp(0.0, seconds, row) for row in (*one.xy.T, *one.velocity.T))
    T = np.eye(4)
    T[:2, :2] = se2.matrix(0.0, 0.0, np.arctan2(vy, vx))[:2, :2]
    T[:3, 3] = x, y, _HEIGHT / 2
    length, width = (max(edge, _MIN_SIZE) for edge in one.size[:2])
    return _marker(bag, stamp, _ADD, one.id, T, (length, width, _HEIGHT))


def _marker(
    bag: BagWriter,
    stamp: int,
    action: int,
    number: int = 0,
    T: NDArray[np.float64] | None = None,
    size: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> Any:
    x, y, z = size
    r, g, b, a = _COLOR
    fields = {
        "header": bag.header(stamp, MAP),
        "ns": "objects",
        "id": number,
        "type": _CUBE,
        "action": action,
        "pose": message_writer.make_pose(bag, np.eye(4) if T is None else T),
        "scale": bag.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
        "color": bag.make("std_msgs/msg/ColorRGBA", r=r, g=g, b=b, a=a),
        "lifetime": bag.make("builtin_interfaces/msg/Duration", sec=0, nanosec=0),
        "frame_locked": False,
        "points": [],
        "colors": [],
        "text": "",
        "mesh_resource": "",
        "mesh_use_embedded_materials": False,
    }
    if not bag.is_ros1:
        empty = np.empty(0, np.uint8)
        image = {"header": bag.header(stamp, ""), "format": "", "data": empty}
        mesh = {"filename": "", "data": empty}
        fields |= {
            "texture_resource": "",
            "texture": bag.make("sensor_msgs/msg/CompressedImage", **image),
            "uv_coordinates": [],
            "mesh_file": bag.make("visualization_msgs/msg/MeshFile", **mesh),
        }
    return bag.make("visualization_msgs/msg/Marker", **fields)
