"""Builds ROS messages from arrays."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stillmap.io.ros.bag_writer import BagWriter
from stillmap.io.ros.messages import ODOMETRY, POINT_CLOUD, TF

BASE, ODOM, MAP = "base_link", "odom", "map"

PATH = "nav_msgs/msg/Path"
GRID = "nav_msgs/msg/OccupancyGrid"
MARKERS = "visualization_msgs/msg/MarkerArray"

_FLOAT32 = 7  # of sensor_msgs/PointField


def make_point_cloud(bag: BagWriter, stamp_ns: int, frame: str, vertices: NDArray[np.void]) -> Any:
    """A PointCloud2 of vertices (n,), whose fields are 4 bytes each; x, y and z in metres.

    All are called FLOAT32, as PCL does with the packed colour of `rgb`, 0x00RRGGBB.
    """
    names = vertices.dtype.names or ()
    fields = [
        bag.make("sensor_msgs/msg/PointField", name=name, offset=4 * k, datatype=_FLOAT32, count=1)
        for k, name in enumerate(names)
    ]
    step = vertices.dtype.itemsize
    if step != 4 * len(names):
        raise ValueError(f"vertices: {vertices.dtype} has other fields than of 4 bytes")
    return bag.make(
        POINT_CLOUD,
        header=bag.header(stamp_ns, frame),
        height=1,
        width=len(vertices),
        fields=fields,
        is_bigendian=False,
        point_step=step,
        row_step=step * len(vertices),
        data=np.ascontiguousarray(vertices).view(np.uint8).ravel(),
        is_dense=all(bool(np.isfinite(vertices[axis]).all()) for axis in "xyz"),
    )


def make_transforms(
    bag: BagWriter, stamp_ns: int, poses: list[tuple[str, str, NDArray[np.float64]]]
) -> Any:
    """A TFMessage of transforms (parent, child, T_parent_child (D+1, D+1))."""
    return bag.make(
        TF,
        transforms=[
            bag.make(
                "geometry_msgs/msg/TransformStamped",
                header=bag.header(stamp_ns, parent),
                child_frame_id=child,
                transform=_transform(bag, T),
            )
            for parent, child, T in poses
        ],
    )


def make_odometry(bag: BagWriter, stamp_ns: int, T_odom_base: NDArray[np.float64]) -> Any:
    """An Odometry message with the pose alone: velocities and covariances are 0."""
    zero = bag.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    twist = bag.make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
    unknown = np.zeros(36)
    return bag.make(
        ODOMETRY,
        header=bag.header(stamp_ns, ODOM),
        child_frame_id=BASE,
        pose=bag.make(
            "geometry_msgs/msg/PoseWithCovariance",
            pose=make_pose(bag, T_odom_base),
            covariance=unknown,
        ),
        twist=bag.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=unknown),
    )


def make_path(bag: BagWriter, stamp_ns: NDArray[np.int64], poses: NDArray[np.float64]) -> Any:
    """A Path in the map frame along T_map_base (T, D+1, D+1)."""
    stamps = stamp_ns.tolist()
    return bag.make(
        PATH,
        header=bag.header(stamps[0], MAP),
        poses=[
            bag.make(
                "geometry_msgs/msg/PoseStamped",
                header=bag.header(stamp, MAP),
                pose=make_pose(bag, T),
            )
            for stamp, T in zip(stamps, poses, strict=True)
        ],
    )


def make_occupancy_grid(
    bag: BagWriter,
    stamp_ns: int,
    p_occupied: NDArray[np.floating[Any]],
    T_map_corner: NDArray[np.float64],
    resolution: float,
) -> Any:
    """An OccupancyGrid in percent, -1 where p_occupied (H, W) is NaN; row 0 is the lowest y.

    T_map_corner (3, 3) is the pose of its lower-left corner, resolution in metres.
    """
    known = ~np.isnan(p_occupied)
    percent = np.where(known, np.rint(100.0 * np.where(known, p_occupied, 0.0)), -1.0)
    height, width = p_occupied.shape
    info = bag.make(
        "nav_msgs/msg/MapMetaData",
        map_load_time=bag.time(stamp_ns),
        resolution=resolution,
        width=width,
        height=height,
        origin=make_pose(bag, T_map_corner),
    )
    data = percent.astype(np.int8).ravel()
    return bag.make(GRID, header=bag.header(stamp_ns, MAP), info=info, data=data)


def make_pose(bag: BagWriter, T: NDArray[np.float64]) -> Any:
    """A Pose of T (D+1, D+1)."""
    position, orientation = _split(bag, T, "Point")
    return bag.make("geometry_msgs/msg/Pose", position=position, orientation=orientation)


def _transform(bag: BagWriter, T: NDArray[np.float64]) -> Any:
    translation, rotation = _split(bag, T, "Vector3")
    return bag.make("geometry_msgs/msg/Transform", translation=translation, rotation=rotation)


def _split(bag: BagWriter, T: NDArray[np.float64], kind: str) -> tuple[Any, Any]:
    """Translation, as a Point or Vector3, and rotation as a Quaternion with w >= 0."""
    D = len(T) - 1
    x, y, z = (*T[:D, D].tolist(), 0.0)[:3]
    if D == 2:
        half = np.arctan2(T[1, 0], T[0, 0]) / 2
        q = (0.0, 0.0, float(np.sin(half)), float(np.cos(half)))
    else:
        q = tuple(Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True).tolist())
    turn = dict(zip("xyzw", q, strict=True))
    return (
        bag.make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z),
        bag.make("geometry_msgs/msg/Quaternion", **turn),
    )
