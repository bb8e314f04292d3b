"""Moving objects of a result as markers: a box and a number for each, at every scan."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.io.ros import writer as ros
from stillmap.io.ros.writer import MAP, BagWriter
from stillmap.results.object_poses import interpolate_pose, iter_present_tracks
from stillmap.results.reader import Track

_BOX_COLOR = (0.9, 0.4, 0.0, 0.8)  # RGBA, the orange of the report
_TEXT_COLOR = (1.0, 1.0, 1.0, 1.0)  # RViz and Foxglove have a dark background
_HEIGHT, _MIN_SIZE = 0.5, 0.1  # m, of the boxes: height in 2D, least edge
_TEXT_HEIGHT, _TEXT_GAP = 0.3, 0.25  # m, of a letter, and above the box
_CUBE, _TEXT, _ADD, _DELETE_ALL = 1, 9, 0, 3  # of visualization_msgs/Marker

Float = NDArray[np.float64]


def make_object_writer(
    bag: BagWriter, tracks: Sequence[Track], stamp_ns: NDArray[np.int64]
) -> Callable[[int], None]:
    """A function that writes the markers at a scan; the scans (T,) come in order.

    Each message begins with a marker that removes the earlier ones.
    """
    send = bag.add_topic("/objects", ros.MARKERS)
    present_at, shown = iter_present_tracks(tracks, stamp_ns), list[int]()

    def write_markers(t: int) -> None:
        nonlocal shown
        before, shown = shown, next(present_at)
        if not before and not shown:
            return
        stamp = int(stamp_ns[t])
        markers = [_make_marker(bag, stamp, {"action": _DELETE_ALL})]
        for n in shown:
            markers += _markers_of(bag, stamp, tracks[n])
        send(stamp, bag.make(ros.MARKERS, markers=markers))

    return write_markers


def _markers_of(bag: BagWriter, stamp: int, track: Track) -> list[Any]:
    """Box and number of an object at the interpolated pose of its track."""
    T = interpolate_pose(track, stamp)
    length, width, height = (max(edge, _MIN_SIZE) for edge in (*track.size, _HEIGHT)[:3])
    if track.z is None:
        T[2, 3] = height / 2
    above = np.eye(4)
    above[:3, 3] = T[:3, 3] + (0.0, 0.0, height / 2 + _TEXT_GAP)
    box = {"ns": "objects", "type": _CUBE, "size": (length, width, height), "color": _BOX_COLOR}
    number = {"ns": "ids", "type": _TEXT, "size": (0.0, 0.0, _TEXT_HEIGHT), "color": _TEXT_COLOR}
    return [
        _make_marker(bag, stamp, {**box, "id": track.id}, T),
        _make_marker(bag, stamp, {**number, "id": track.id, "text": str(track.id)}, above),
    ]


def _make_marker(bag: BagWriter, stamp: int, more: dict[str, Any], T: Float | None = None) -> Any:
    """A Marker at a pose (4, 4) with `size`, `color` and other fields."""
    x, y, z = more.pop("size", (1.0, 1.0, 1.0))
    r, g, b, a = more.pop("color", _BOX_COLOR)
    fields = {
        "header": bag.header(stamp, MAP),
        "ns": "objects",
        "id": 0,
        "type": _CUBE,
        "action": _ADD,
        "pose": ros.make_pose(bag, np.eye(4) if T is None else T),
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
    return bag.make("visualization_msgs/msg/Marker", **(fields | more))
