"""Writes ROS bags of any kind, message by message, and the messages of recordings and results."""

import os
import shutil
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from rosbags import rosbag1, rosbag2
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from stillmap.core.errors import InputError
from stillmap.core.files import (
    atomic_file,
    atomic_folder,
    resolve_output,
    shorten,
    temporary_folder,
)
from stillmap.core.recording import Recording
from stillmap.io import laser_scan
from stillmap.io.ros.messages import (
    LASER_SCAN,
    ODOMETRY,
    POINT_CLOUD,
    TF,
    BagKind,
    Channel,
    load_typestore,
)

Float = NDArray[np.float64]
Send = Callable[[int, Any], None]  # stamp in ns, message
SendRaw = Callable[[int, bytes], None]

BASE, ODOM, MAP = "base_link", "odom", "map"
PATH = "nav_msgs/msg/Path"
GRID = "nav_msgs/msg/OccupancyGrid"
MARKERS = "visualization_msgs/msg/MarkerArray"

_FLOAT32 = 7  # of sensor_msgs/PointField
# the oldest version that stores message definitions: ROS 2 before Jazzy reads no newer one
_VERSION: Literal[8] = 8
_MAX_SECONDS = {"bag": 1 << 32, "ros2": 1 << 31, "db3": 1 << 31, "mcap": 1 << 31}  # of stamps
_FOREVER = QosTime(9223372036, 854775807)
_TRANSIENT_LOCAL = Qos(
    QosHistory.KEEP_LAST,
    1,
    QosReliability.RELIABLE,
    QosDurability.TRANSIENT_LOCAL,
    _FOREVER,
    _FOREVER,
    QosLiveliness.AUTOMATIC,
    _FOREVER,
    False,
)


class BagWriter:
    """An open bag of a kind, written through an open writer of rosbags."""

    def __init__(self, kind: BagKind, writer: rosbag1.Writer | rosbag2.Writer) -> None:
        self.is_ros1 = kind == "bag"
        self._writer = writer
        self._store = store = load_typestore("ros1" if self.is_ros1 else "cdr")
        self._serialize = store.serialize_ros1 if self.is_ros1 else store.serialize_cdr

    def add_topic(self, name: str, type: str, *, latched: bool = False) -> Send:
        """Add a topic; returns a function that writes a message at a stamp in nanoseconds.

        Args:
            name: with its slash.
            type: as `sensor_msgs/msg/LaserScan`.
            latched: late subscribers still get the last message.
        """
        writer, serialize = self._writer, self._serialize
        connection = self._add_connection(name, type, latched, typestore=self._store)
        return lambda stamp, message: writer.write(connection, stamp, serialize(message, type))

    def copy_topic(self, channel: Channel) -> SendRaw | None:
        """Add a topic like one of another bag; returns a function that writes raw messages.

        None where the definition of its type is not known.
        """
        options: dict[str, Any] = {"typestore": self._store}
        digest = channel.digest or _digest(channel)
        if channel.definition and digest:
            hash_name = "md5sum" if self.is_ros1 else "rihs01"
            options = {"msgdef": channel.definition, hash_name: digest}
        elif channel.type not in self._store.fielddefs:
            return None
        if self.is_ros1 and channel.publisher:
            options["callerid"] = channel.publisher
        if not self.is_ros1 and channel.qos:
            options["offered_qos_profiles"] = list(channel.qos)
        writer = self._writer
        connection = self._add_connection(channel.topic, channel.type, channel.latched, **options)
        return lambda stamp, raw: writer.write(connection, stamp, raw)

    def serialize(self, message: Any, type: str) -> bytes:
        """The bytes of a message in this kind of bag."""
        return bytes(self._serialize(message, type))

    def make(self, type: str, /, **fields: Any) -> Any:
        """A message or a part of one."""
        return self._store.types[type](**fields)

    def time(self, stamp_ns: int) -> Any:
        """A time; never negative."""
        sec, nanosec = divmod(stamp_ns, 10**9)
        return self.make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)

    def header(self, stamp_ns: int, frame: str) -> Any:
        """The header of a message."""
        seq = {"seq": 0} if self.is_ros1 else {}
        stamp = self.time(stamp_ns)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **seq)

    def _add_connection(self, topic: str, type: str, latched: bool, **options: Any) -> Any:
        if self.is_ros1:
            options = {"callerid": "/stillmap", "latching": int(latched), **options}
        else:
            options = {"offered_qos_profiles": [_TRANSIENT_LOCAL] if latched else [], **options}
        return self._writer.add_connection(topic, type, **options)


def _digest(channel: Channel) -> str:
    """The hash of a ROS 2 type from its definition; "" where that is missing or invalid."""
    if channel.encoding == "ros1" or not channel.definition:
        return ""
    store = get_typestore(Stores.EMPTY)
    try:
        store.register(get_types_from_msg(channel.definition, channel.type))
        return store.hash_rihs01(channel.type)
    except Exception:  # any error of rosbags about a text that is no definition
        return ""


@contextmanager
def new_bag(
    path: Path, kind: BagKind, *, overwrite: bool = False, mcap: bool = False
) -> Iterator[BagWriter]:
    """Write a bag, which lies at `path` once the block ends without an exception.

    Args:
        path: a file, or the folder of kind "ros2".
        kind: ROS 1 `bag`; `ros2`, a folder with `metadata.yaml`; its file alone: `db3` or `mcap`.
        overwrite: replace an existing folder; a file is replaced in any case.
        mcap: store messages of kind "ros2" as MCAP.

    Raises:
        InputError: it cannot be written.
    """
    with ExitStack() as stack:
        if kind == "ros2":
            work = stack.enter_context(atomic_folder(path, "metadata.yaml", overwrite))
        else:
            work = stack.enter_context(atomic_file(path))
        # rosbags refuses existing files; for ROS 2 it makes a folder, and names its files after it
        beside = stack.enter_context(temporary_folder(path))
        stack.enter_context(_sqlite_errors(path))
        if kind == "bag":
            with rosbag1.Writer(beside / "bag") as writer1:
                yield BagWriter(kind, writer1)
            os.replace(beside / "bag", work)
            return
        mcap |= kind == "mcap"
        plugin = rosbag2.StoragePlugin.MCAP if mcap else rosbag2.StoragePlugin.SQLITE3
        folder = beside / (shorten(resolve_output(path).name) if kind == "ros2" else "bag")
        writer2 = rosbag2.Writer(folder, version=_VERSION, storage_plugin=plugin)
        if mcap:
            compression = rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD
            writer2.set_compression(*compression)
        with writer2:
            yield BagWriter(kind, writer2)
        if kind == "ros2":
            for file in folder.iterdir():
                shutil.move(file, work / file.name)
        else:
            shutil.move(folder / f"{folder.name}.{kind}", work)


@contextmanager
def _sqlite_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except sqlite3.Error as error:  # a full disk
        raise InputError(f"cannot be written: {error}", where=str(path)) from error


def require_stamps(first_ns: int, last_ns: int, kind: BagKind) -> None:
    """Refuse stamps that such a bag cannot hold.

    Raises:
        InputError: they are negative or too late.
    """
    if first_ns < 0 or last_ns >= _MAX_SECONDS[kind] * 10**9:
        span = f"stamps from {first_ns / 1e9:.0f} to {last_ns / 1e9:.0f} s"
        hint = f"0 to {_MAX_SECONDS[kind]} s"
        raise InputError(f"{span} do not fit into a ROS bag", hint=hint)


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


def make_transforms(bag: BagWriter, stamp_ns: int, poses: list[tuple[str, str, Float]]) -> Any:
    """A TFMessage of transforms (parent, child, T_parent_child (D+1, D+1))."""
    transforms = []
    for parent, child, T in poses:
        translation, rotation = _split(bag, T, "Vector3")
        transforms.append(
            bag.make(
                "geometry_msgs/msg/TransformStamped",
                header=bag.header(stamp_ns, parent),
                child_frame_id=child,
                transform=bag.make(
                    "geometry_msgs/msg/Transform", translation=translation, rotation=rotation
                ),
            )
        )
    return bag.make(TF, transforms=transforms)


def make_odometry(bag: BagWriter, stamp_ns: int, T_odom_base: Float) -> Any:
    """An Odometry message with the pose alone: velocities and covariances are 0."""
    zero = bag.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    twist = bag.make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
    unknown, pose = np.zeros(36), make_pose(bag, T_odom_base)
    return bag.make(
        ODOMETRY,
        header=bag.header(stamp_ns, ODOM),
        child_frame_id=BASE,
        pose=bag.make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=unknown),
        twist=bag.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=unknown),
    )


def make_path(bag: BagWriter, stamp_ns: NDArray[np.int64], poses: Float) -> Any:
    """A Path in the map frame along T_map_base (T, D+1, D+1)."""
    headers = [bag.header(stamp, MAP) for stamp in stamp_ns.tolist()]
    stamped = [
        bag.make("geometry_msgs/msg/PoseStamped", header=header, pose=make_pose(bag, T))
        for header, T in zip(headers, poses, strict=True)
    ]
    return bag.make(PATH, header=headers[0], poses=stamped)


def make_occupancy_grid(
    bag: BagWriter,
    stamp_ns: int,
    p_occupied: NDArray[np.floating[Any]],
    T_map_corner: Float,
    resolution: float,
) -> Any:
    """An OccupancyGrid in percent, -1 where p_occupied (H, W) is NaN; row 0 is the lowest y.

    T_map_corner (3, 3) is the pose of its lower-left corner, resolution in metres.
    """
    known = ~np.isnan(p_occupied)
    percent = np.where(known, np.rint(100.0 * np.where(known, p_occupied, 0.0)), -1.0)
    info = bag.make(
        "nav_msgs/msg/MapMetaData",
        map_load_time=bag.time(stamp_ns),
        resolution=resolution,
        width=p_occupied.shape[1],
        height=p_occupied.shape[0],
        origin=make_pose(bag, T_map_corner),
    )
    data = percent.astype(np.int8).ravel()
    return bag.make(GRID, header=bag.header(stamp_ns, MAP), info=info, data=data)


def make_pose(bag: BagWriter, T: Float) -> Any:
    """A Pose of T (D+1, D+1)."""
    position, orientation = _split(bag, T, "Point")
    return bag.make("geometry_msgs/msg/Pose", position=position, orientation=orientation)


def _split(bag: BagWriter, T: Float, kind: str) -> tuple[Any, Any]:
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


def write_recording(
    recording: Recording, path: Path, kind: BagKind, *, overwrite: bool = False
) -> list[str]:
    """Write a recording as a ROS bag: scans, odometry, and the sensors' extrinsics.

    2D scans become LaserScan on `/scan`, `/scan2`, ..., with +inf for no return (REP 117), 3D
    scans PointCloud2 on `/points`, ...; odometry becomes Odometry on `/odom` and transforms from
    odom to base_link at every scan. All stamps are the recording's.

    Returns:
        What could not be written, a sentence each.

    Raises:
        InputError: the bag cannot be written or cannot hold such a recording.
    """
    stamps, n_free = recording.stamp_ns, 0
    if recording.n_scans:
        require_stamps(int(stamps[0]), int(stamps[-1]), kind)
    lasers = LaserScanEncoder(recording) if recording.dimension == 2 else None
    with new_bag(path, kind, overwrite=overwrite) as bag:
        frames = write_sensor_frames(bag, recording)
        topic, type = ("scan", LASER_SCAN) if lasers is not None else ("points", POINT_CLOUD)
        sends = [bag.add_topic(f"/{name}", type) for name in number_names(topic, len(frames))]
        send_odometry = _odometry_sender(bag, recording)
        for t in recording.iter_scans(range(recording.n_scans)):
            send_odometry(t)
            sensor, beams = int(recording.sensor[t]), recording.beams_of(t)
            if lasers is None:
                message = _make_cloud(bag, recording, t, frames[sensor])
                free = recording.points[beams][~recording.hit[beams]]
                n_free += int(np.count_nonzero(~np.isnan(free).any(axis=1)))
            else:
                message = lasers.make_message(bag, t, frames[sensor], lasers.ranges(t))
            sends[sensor](int(stamps[t]), message)
    lost = [f"{n_free} beams at maximum range are left out: they have no points"] * bool(n_free)
    return lost if lasers is None else lasers.describe_losses()


class LaserScanEncoder:
    """Encodes the scans of a 2D recording as LaserScan messages.

    Raises:
        InputError: the beam directions of a scan are not evenly spaced.
    """

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._angles = laser_scan.beam_angles(recording)
        self._range_max = [limits.max_range() for limits in laser_scan.range_limits(recording)]
        self._time_increments, self._n_uneven = laser_scan.time_increments(recording)

    def ranges(self, t: int) -> NDArray[np.float32]:
        """(n,) metres of a scan, +inf at maximum range, NaN where unusable."""
        return laser_scan.beam_ranges(self._recording, t, np.inf).astype(np.float32)

    def make_message(self, bag: BagWriter, t: int, frame: str, ranges: NDArray[np.float32]) -> Any:
        """The message of scan t with ranges (n,)."""
        start, step = self._angles[t].tolist()
        return bag.make(
            LASER_SCAN,
            header=bag.header(int(self._recording.stamp_ns[t]), frame),
            angle_min=start,
            angle_max=start + step * max(len(ranges) - 1, 0),
            angle_increment=step,
            time_increment=float(self._time_increments[t]),
            scan_time=0.0,
            range_min=0.0,
            range_max=self._range_max[self._recording.sensor[t]],
            ranges=ranges,
            intensities=np.empty(0, np.float32),
        )

    def describe_losses(self) -> list[str]:
        """Lists the parts of a recording that ROS messages cannot hold, one sentence each."""
        what = f"beam times of {self._n_uneven} scans are left out: LaserScan holds times that "
        return [f"{what}begin at the stamp and rise evenly"] if self._n_uneven else []


def write_sensor_frames(
    bag: BagWriter, recording: Recording, more: Sequence[tuple[str, str, Float]] = ()
) -> list[str]:
    """Write the sensors' extrinsics to /tf_static, and more transforms (parent, child, T); returns
    their S frames."""
    S = len(recording.T_base_sensor)
    frames = number_names("laser" if recording.dimension == 2 else "lidar", S)
    send = bag.add_topic("/tf_static", TF, latched=True)
    if recording.n_scans:
        first = int(recording.stamp_ns[0])
        poses = [(BASE, f, T) for f, T in zip(frames, recording.T_base_sensor, strict=True)]
        send(first, make_transforms(bag, first, [*poses, *more]))
    return frames


def number_names(name: str, count: int) -> list[str]:
    """`name`, `name2`, `name3`, ..."""
    return [name, *(f"{name}{k}" for k in range(2, count + 1))][:count]


def _odometry_sender(bag: BagWriter, recording: Recording) -> Callable[[int], None]:
    """A function that writes the odometry of a scan."""
    T_odom_base = recording.T_odom_base
    if T_odom_base is None:
        return lambda t: None  # noqa: ARG005
    send_tf = bag.add_topic("/tf", TF)
    send_odometry = bag.add_topic("/odom", ODOMETRY)

    def send(t: int) -> None:
        stamp, T = int(recording.stamp_ns[t]), T_odom_base[t]
        if t and stamp == recording.stamp_ns[t - 1] and np.array_equal(T, T_odom_base[t - 1]):
            return  # two sensors at the same time
        send_tf(stamp, make_transforms(bag, stamp, [(ODOM, BASE, T)]))
        send_odometry(stamp, make_odometry(bag, stamp, T))

    return send


def _make_cloud(bag: BagWriter, recording: Recording, t: int, frame: str) -> Any:
    """A PointCloud2 with field `t`, in seconds after the stamp, where beams have times."""
    beams, times = recording.beams_of(t), recording.beam_time
    names = "xyz" if times is None else "xyzt"
    vertices = np.empty(beams.stop - beams.start, [(name, "<f4") for name in names])
    # readers would take a point at maximum range for a return
    points = np.where(recording.hit[beams, None], recording.points[beams], np.float32(np.nan))
    vertices["x"], vertices["y"], vertices["z"] = points.T
    if times is not None:
        vertices["t"] = times[beams]
    return make_point_cloud(bag, int(recording.stamp_ns[t]), frame, vertices)
