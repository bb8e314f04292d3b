"""A live mapper seen in Foxglove or Lichtblick: its answers on channels of foxglove-sdk."""

import logging
import math
import time
from collections.abc import Iterator, Sequence

import numpy as np
from foxglove import Context, channels, start_server
from foxglove import messages as fox
from foxglove.websocket import Capability, ServerListener
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.array_types import Float, Float32
from stillmap.core.errors import InputError
from stillmap.core.grid_map import GridMap
from stillmap.io.trajectory import embed_in_3d, quaternion_from_pose
from stillmap.live.mapper import LiveMapper
from stillmap.live.movers import Mover
from stillmap.live.scan import ScanBeams
from stillmap.live.update import DOUBTS, Update
from stillmap.results.colors import BLUE, ORANGE, Rgb

HOST, PORT = "127.0.0.1", 8765
MAP, ODOM, BASE = "map", "odom", "base"  # frames

_PERIOD = 1.0  # s at least between two maps, and between two paths
_BACKLOG = 128  # messages that wait for a client that does not read; the oldest are dropped
_MAX_CELLS, _MAX_POINTS, _MAX_PATH = 4_000_000, 1_000_000, 5000  # viewers draw no more
_OCCUPIED = 0.65  # P(occupied) of the voxels that are shown in 3D
_MOVER_HEIGHT, _PATH_HEIGHT = 1.7, 0.02  # m
_VOXELS: Rgb = (80, 80, 80)
_POINT = np.dtype([("position", "<f4", 3), ("color", "u1", 4), ("p_static", "<f4")])
_Field, _Kind = fox.PackedElementField, fox.PackedElementFieldNumericType
_CELL = ("red", "green", "blue", "alpha", "occupancy")
_CELL_FIELDS = [_Field(name=name, offset=k, type=_Kind.Uint8) for k, name in enumerate(_CELL)]
_POINT_FIELDS = [
    *(_Field(name=name, offset=4 * k, type=_Kind.Float32) for k, name in enumerate("xyz")),
    *(_Field(name=name, offset=12 + k, type=_Kind.Uint8) for k, name in enumerate(_CELL[:4])),
    _Field(name="p_static", offset=16, type=_Kind.Float32),
]


class FoxgloveServer(ServerListener):
    """Serves map, labelled scans, movers, pose, path and doubts over a WebSocket.

    Args:
        host: address to listen at; who reaches it can watch.
        port: 0: any free one.

    Attributes:
        url: of the server.

    Raises:
        InputError: the port is taken, or the host is none of this machine.
    """

    def __init__(self, host: str = HOST, port: int = PORT) -> None:
        if not 0 <= port < 1 << 16:
            raise InputError(f"the port is from 0 to 65535, not {port}")
        # it has a line about each client whose request is malformed
        logging.getLogger("foxglove").setLevel(logging.CRITICAL)
        self._context = context = Context()
        self._map = channels.GridChannel("/map", context=context)
        self._voxels = channels.PointCloudChannel("/map_points", context=context)
        self._pose = channels.PoseInFrameChannel("/pose", context=context)
        self._path = channels.SceneUpdateChannel("/path", context=context)
        self._movers = channels.SceneUpdateChannel("/movers", context=context)
        self._tf = channels.FrameTransformsChannel("/tf", context=context)
        self._doubts = channels.LogChannel("/doubts", context=context)
        self._clouds = dict[str | int, list[channels.PointCloudChannel]]()
        self._last_doubts: tuple[str, ...] | None = None
        self._due = 0.0
        try:
            self._server = start_server(
                name="stillmap",
                host=host,
                port=port,
                context=context,
                capabilities=[Capability.Time],  # nobody may publish, call or set anything
                server_listener=self,
                message_backlog_size=_BACKLOG,
            )
        except RuntimeError as error:
            reason = str(error).rpartition(": ")[2].partition(" (os error")[0].lower()
            raise InputError(f"cannot serve at {host}:{port}: {reason}") from error
        address = f"[{host}]" if ":" in host else host
        self.url = f"ws://{address}:{self._server.port}"

    def __enter__(self) -> "FoxgloveServer":
        return self

    def __exit__(self, *_: object) -> None:
        self._server.stop()

    def on_subscribe(self, *_: object) -> None:
        """Who comes late gets the map, the path and the doubts with the next scan."""
        self._due, self._last_doubts = 0.0, None

    def show(self, mapper: LiveMapper, beams: ScanBeams, update: Update) -> None:
        """Show what the mapper answered to a scan, to those who watch.

        Args:
            mapper: which is not pushed to meanwhile.
            beams: the scan.
            update: the answer.
        """
        ns = max(beams.stamp_ns, 0)
        stamp = to_timestamp(ns)
        self._server.broadcast_time(ns)
        self._tf.log(to_transforms(update, stamp), log_time=ns)
        pose = fox.PoseInFrame(timestamp=stamp, frame_id=MAP, pose=_pose(update.pose))
        self._pose.log(pose, log_time=ns)
        self._movers.log(to_movers(update.movers, stamp), log_time=ns)
        if update.doubts != self._last_doubts:
            self._last_doubts = update.doubts
            self._doubts.log(to_log(update.doubts, stamp), log_time=ns)
        clouds = self._clouds_of(beams.sensor)
        if any(channel.has_sinks() for channel in clouds):
            for channel, cloud in zip(clouds, to_clouds(beams, update, stamp), strict=True):
                channel.log(cloud, log_time=ns)
        if (now := time.monotonic()) >= self._due:
            self._due = now + _PERIOD
            self._show_map(mapper, len(update.pose) - 1, ns)

    def _show_map(self, mapper: LiveMapper, dimension: int, ns: int) -> None:
        """Map and path, which take long."""
        stamp = to_timestamp(ns)
        if dimension == 2 and self._map.has_sinks():
            self._map.log(to_grid(mapper.map, stamp), log_time=ns)
        if dimension == 3 and self._voxels.has_sinks():
            known = mapper.cells
            centers = (known.cells[known.p_occupied > _OCCUPIED] + 0.5) * mapper.resolution
            points = centers[:: max(1, -(-len(centers) // _MAX_POINTS))].astype(np.float32)
            p_static = np.ones(len(points), np.float32)
            self._voxels.log(_cloud(stamp, np.eye(4), points, p_static, _VOXELS), log_time=ns)
        if self._path.has_sinks():
            self._path.log(to_path(mapper.path[:, :dimension, dimension], stamp), log_time=ns)

    def _clouds_of(self, sensor: str | int) -> list[channels.PointCloudChannel]:
        """Channels of a sensor, as the node in ROS 2 names its topics; without a name `scan`."""
        if sensor not in self._clouds:
            name = str(sensor).strip("/") if sensor else "scan"
            name = f"scan_{sensor}" if sensor and isinstance(sensor, int) else name
            self._clouds[sensor] = [
                channels.PointCloudChannel(f"/{name}_{label}", context=self._context)
                for label in ("static", "dynamic")
            ]
        return self._clouds[sensor]


def to_timestamp(ns: int) -> fox.Timestamp:
    """Nanoseconds."""
    return fox.Timestamp(*divmod(ns, 10**9))


def to_transforms(update: Update, stamp: fox.Timestamp) -> fox.FrameTransforms:
    """From the map to the odometry, and on to the robot; without odometry to the robot."""
    pairs, T = [(MAP, BASE, _parts(update.pose))], update.T_map_odom
    if T is not None:
        pairs = [(MAP, ODOM, _parts(T)), (ODOM, BASE, _parts(se2.inverse(T) @ update.pose))]
    return fox.FrameTransforms(
        transforms=[
            fox.FrameTransform(
                timestamp=stamp,
                parent_frame_id=parent,
                child_frame_id=child,
                translation=position,
                rotation=rotation,
            )
            for parent, child, (position, rotation) in pairs
        ]
    )


def to_clouds(beams: ScanBeams, update: Update, stamp: fox.Timestamp) -> Iterator[fox.PointCloud]:
    """The static and the dynamic hits of a scan. They have the pose of the sensor in the map, so
    that they need no transform."""
    p_static = update.p_static
    usable, is_dynamic = beams.hit & ~np.isnan(p_static), p_static < 0.5
    T = update.pose @ beams.T_base_sensor
    for chosen, color in ((usable & ~is_dynamic, BLUE), (usable & is_dynamic, ORANGE)):
        yield _cloud(stamp, T, beams.points[chosen], p_static[chosen], color)


def to_grid(grid: GridMap, stamp: fox.Timestamp) -> fox.Grid:
    """A planar map in grey levels, transparent where it is unknown; of a large one several cells
    as one, as occupied as the most occupied of them."""
    p = np.nan_to_num(np.asarray(grid.p_occupied), nan=-1.0)
    k = max(math.ceil(math.sqrt(p.size / _MAX_CELLS)), 1)
    for axis in (0, 1):
        p = np.maximum.reduceat(p, np.arange(0, p.shape[axis], k), axis) if p.size else p
    cells = np.zeros((*p.shape, 5), np.uint8)
    cells[..., :3] = np.rint(245.0 - 225.0 * np.maximum(p, 0.0))[..., None]
    cells[..., 3] = np.where(p < 0.0, 0, 255)
    cells[..., 4] = np.where(p < 0.0, 255, np.rint(100.0 * p))
    edge = k * float(grid.resolution)
    return fox.Grid(
        timestamp=stamp,
        frame_id=MAP,
        pose=_pose(se2.matrix(*grid.origin)),
        column_count=p.shape[1],
        cell_size=fox.Vector2(x=edge, y=edge),
        row_stride=5 * p.shape[1],
        cell_stride=5,
        fields=_CELL_FIELDS,
        data=cells.tobytes(),
    )


def to_path(positions: Float, stamp: fox.Timestamp) -> fox.SceneUpdate:
    """A line through positions (S, D) in the map."""
    points = _lift(positions, _PATH_HEIGHT)[:: max(1, -(-len(positions) // _MAX_PATH))]
    line = fox.LinePrimitive(
        type=fox.LinePrimitiveLineType.LineStrip,
        pose=_pose(np.eye(4)),
        thickness=0.05,
        points=[fox.Point3(x=x, y=y, z=z) for x, y, z in points.tolist()],
        color=_color(BLUE),
    )
    entity = fox.SceneEntity(timestamp=stamp, frame_id=MAP, id="path", lines=[line])
    return fox.SceneUpdate(entities=[entity])


def to_movers(movers: Sequence[Mover], stamp: fox.Timestamp) -> fox.SceneUpdate:
    """A cylinder for each mover, and an arrow as long as its way in a second.

    Those of before go: a message may be lost on the way.
    """
    every = fox.SceneEntityDeletion(timestamp=stamp, type=fox.SceneEntityDeletionType.All)
    return fox.SceneUpdate(deletions=[every], entities=[_mover(stamp, mover) for mover in movers])


def to_log(doubts: tuple[str, ...], stamp: fox.Timestamp) -> fox.Log:
    """One line about what is in doubt."""
    level = fox.LogLevel.Warning if doubts else fox.LogLevel.Info
    text = "; ".join(DOUBTS[name] for name in doubts) or "no doubts"
    return fox.Log(timestamp=stamp, level=level, name="stillmap", message=text)


def _mover(stamp: fox.Timestamp, mover: Mover) -> fox.SceneEntity:
    width, speed = 2.0 * mover.radius, math.hypot(*mover.velocity)
    upright = np.eye(4)
    upright[:3, 3] = _lift(mover.position[None], 0.5 * _MOVER_HEIGHT)[0]
    heading = se2.matrix(0.0, 0.0, math.atan2(mover.velocity[1], mover.velocity[0]))
    on_top = upright @ embed_in_3d(heading)
    on_top[2, 3] += 0.5 * _MOVER_HEIGHT
    body = fox.CylinderPrimitive(
        pose=_pose(upright),
        size=fox.Vector3(x=width, y=width, z=_MOVER_HEIGHT),
        bottom_scale=1.0,
        top_scale=1.0,
        color=_color(ORANGE, 0.5),
    )
    arrow = fox.ArrowPrimitive(
        pose=_pose(on_top),
        shaft_length=0.8 * speed,
        shaft_diameter=0.1,
        head_length=0.2 * speed,
        head_diameter=0.2,
        color=_color(ORANGE),
    )
    return fox.SceneEntity(
        timestamp=stamp, frame_id=MAP, id=str(mover.number), cylinders=[body], arrows=[arrow]
    )


def _cloud(
    stamp: fox.Timestamp, T: Float, points: Float32, p_static: Float32, color: Rgb
) -> fox.PointCloud:
    rows = np.zeros(len(points), _POINT)
    rows["position"], rows["p_static"], rows["color"] = _lift(points), p_static, (*color, 255)
    return fox.PointCloud(
        timestamp=stamp,
        frame_id=MAP,
        pose=_pose(T),
        point_stride=_POINT.itemsize,
        fields=_POINT_FIELDS,
        data=rows.tobytes(),
    )


def _lift(points: NDArray[np.floating], z: float = 0.0) -> NDArray[np.floating]:
    """(n, 3) points of (n, 2), at a height, or (n, 3)."""
    out = np.full((len(points), 3), z, points.dtype)
    out[:, : points.shape[1]] = points
    return out


def _parts(T: Float) -> tuple[fox.Vector3, fox.Quaternion]:
    T = embed_in_3d(T)
    x, y, z = T[:3, 3].tolist()
    w, i, j, k = quaternion_from_pose(T).tolist()
    return fox.Vector3(x=x, y=y, z=z), fox.Quaternion(x=i, y=j, z=k, w=w)


def _pose(T: Float) -> fox.Pose:
    position, orientation = _parts(T)
    return fox.Pose(position=position, orientation=orientation)


def _color(rgb: Rgb, alpha: float = 1.0) -> fox.Color:
    r, g, b = (value / 255.0 for value in rgb)
    return fox.Color(r=r, g=g, b=b, a=alpha)
