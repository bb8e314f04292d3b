"""Messages of Foxglove's well-known schemas, of what the live mapper says. In 2D z is 0."""

import math

import numpy as np
from foxglove.messages import (
    ArrowPrimitive,
    Color,
    CylinderPrimitive,
    FrameTransform,
    FrameTransforms,
    Grid,
    LinePrimitive,
    LinePrimitiveLineType,
    Log,
    LogLevel,
    PackedElementField,
    PackedElementFieldNumericType,
    Point3,
    PointCloud,
    Pose,
    PoseInFrame,
    Quaternion,
    SceneEntity,
    SceneEntityDeletion,
    SceneEntityDeletionType,
    SceneUpdate,
    TextPrimitive,
    Timestamp,
    Vector2,
    Vector3,
)
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.io.rigid_transforms import quaternion_from_pose
from stillmap.live.foxglove.answer import Answer
from stillmap.live.foxglove.tile_map import UNKNOWN, Cells
from stillmap.live.update import DOUBTS
from stillmap.results.colors import BLUE, ORANGE, Rgb

Float = NDArray[np.float64]

MAP, ODOM, BASE = "map", "odom", "base"  # frames

_NS, _MAX_SECONDS = 10**9, 2**32 - 1
_FREE, _OCCUPIED = 245, 20  # grey
_HEIGHT = 0.02  # m of the path above the map
_MOVER_HEIGHT = 1.7  # m
_SHAFT, _ARROW_WIDTH, _FONT_SIZE = 0.8, 0.1, 0.4  # share of an arrow's length; m; m
_LINE_WIDTH = 0.05  # m
_MAX_PATH = 5000  # points
_RGBA = [
    (name, k, PackedElementFieldNumericType.Uint8)
    for k, name in enumerate(("red", "green", "blue", "alpha"))
]
_POINT = np.dtype([("position", "<f4", 3), ("color", "u1", 4), ("p_static", "<f4")])


def to_timestamp(stamp_ns: int) -> Timestamp:
    """Nanoseconds; what the schema cannot hold becomes the nearest that it can."""
    seconds, rest = divmod(stamp_ns, _NS)
    return Timestamp(min(max(seconds, 0), _MAX_SECONDS), rest)


def to_pose(T: Float) -> Pose:
    """A pose (D+1, D+1)."""
    return Pose(position=_translation(T), orientation=_rotation(T))


def to_pose_in_frame(answer: Answer) -> PoseInFrame:
    """The pose of the robot in the map."""
    pose = to_pose(answer.T_map_base)
    return PoseInFrame(timestamp=to_timestamp(answer.stamp_ns), frame_id=MAP, pose=pose)


def to_transforms(answer: Answer) -> FrameTransforms:
    """From the map to the odometry, and on to the robot; without odometry to the robot."""
    pairs = [(MAP, BASE, answer.T_map_base)]
    if answer.T_map_odom is not None:
        T_odom_base = se2.inverse(answer.T_map_odom) @ answer.T_map_base
        pairs = [(MAP, ODOM, answer.T_map_odom), (ODOM, BASE, T_odom_base)]
    return FrameTransforms(
        transforms=[
            FrameTransform(
                timestamp=to_timestamp(answer.stamp_ns),
                parent_frame_id=parent,
                child_frame_id=child,
                translation=_translation(T),
                rotation=_rotation(T),
            )
            for parent, child, T in pairs
        ]
    )


def to_clouds(answer: Answer) -> tuple[PointCloud, PointCloud]:
    """The hits of a scan: those of what stands, and those of what moves.

    They have the pose of the sensor in the map, so that they need no transform.
    """
    usable = answer.hit & ~np.isnan(answer.p_static)
    moves = answer.p_static < 0.5
    T = answer.T_map_base @ answer.T_base_sensor
    static, dynamic = (
        _cloud(answer.stamp_ns, T, answer.points[kept], answer.p_static[kept], color)
        for kept, color in ((usable & ~moves, BLUE), (usable & moves, ORANGE))
    )
    return static, dynamic


def to_grid(cells: Cells, stamp_ns: int) -> Grid:
    """A planar map: grey levels, transparent where it is unknown, and per cent."""
    percent = cells.percent
    one = PackedElementFieldNumericType.Uint8
    return Grid(
        timestamp=to_timestamp(stamp_ns),
        frame_id=MAP,
        pose=Pose(position=_vector(cells.origin), orientation=Quaternion(w=1.0)),
        column_count=percent.shape[1],
        cell_size=Vector2(x=cells.edge, y=cells.edge),
        row_stride=_CELLS.shape[1] * percent.shape[1],
        cell_stride=_CELLS.shape[1],
        fields=_fields([*_RGBA, ("occupancy", len(_RGBA), one)]),
        data=_CELLS[percent].tobytes(),
    )


def to_map_cloud(points: NDArray[np.float32], stamp_ns: int) -> PointCloud:
    """A map in 3D: its occupied voxels, at points (n, 3)."""
    p_static = np.ones(len(points), np.float32)
    return _cloud(stamp_ns, np.eye(4), points, p_static, (_OCCUPIED + 60,) * 3)


def to_path(positions: Float, stamp_ns: int) -> SceneUpdate:
    """A line through positions (S, D) in the map."""
    points = _lift(positions)[:: max(1, -(-len(positions) // _MAX_PATH))]
    if positions.shape[1] == 2:
        points[:, 2] = _HEIGHT
    line = LinePrimitive(
        type=LinePrimitiveLineType.LineStrip,
        pose=Pose(position=Vector3(), orientation=Quaternion(w=1.0)),
        thickness=_LINE_WIDTH,
        points=[Point3(x=x, y=y, z=z) for x, y, z in points.tolist()],
        color=_color(BLUE),
    )
    stamp = to_timestamp(stamp_ns)
    entity = SceneEntity(timestamp=stamp, frame_id=MAP, id="path", lines=[line])
    return SceneUpdate(entities=[entity])


def to_movers(answer: Answer) -> SceneUpdate:
    """A cylinder with its number for each mover, and an arrow as long as its way in a second.

    Those of before go: a message may be lost on the way.
    """
    stamp, movers = to_timestamp(answer.stamp_ns), answer.movers
    every = SceneEntityDeletion(timestamp=stamp, type=SceneEntityDeletionType.All)
    rows = zip(*(column.tolist() for column in movers), strict=True)
    return SceneUpdate(deletions=[every], entities=[_mover(stamp, *row) for row in rows])


def to_log(doubts: tuple[str, ...], stamp_ns: int) -> Log:
    """One line about what is in doubt."""
    level = LogLevel.Warning if doubts else LogLevel.Info
    text = "; ".join(DOUBTS[name] for name in doubts) or "no doubts"
    return Log(timestamp=to_timestamp(stamp_ns), level=level, name="stillmap", message=text)


def _mover(
    stamp: Timestamp, number: int, position: list[float], velocity: list[float], radius: float
) -> SceneEntity:
    x, y, z = position if len(position) == 3 else (*position, 0.5 * _MOVER_HEIGHT)
    speed, half = math.hypot(*velocity), 0.5 * math.atan2(velocity[1], velocity[0])
    upright = Pose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(w=1.0))
    top = Vector3(x=x, y=y, z=z + 0.5 * _MOVER_HEIGHT)
    body = CylinderPrimitive(
        pose=upright,
        size=Vector3(x=2.0 * radius, y=2.0 * radius, z=_MOVER_HEIGHT),
        bottom_scale=1.0,
        top_scale=1.0,
        color=_color(ORANGE, 0.5),
    )
    arrow = ArrowPrimitive(
        pose=Pose(position=top, orientation=Quaternion(z=math.sin(half), w=math.cos(half))),
        shaft_length=_SHAFT * speed,
        shaft_diameter=_ARROW_WIDTH,
        head_length=(1.0 - _SHAFT) * speed,
        head_diameter=2.0 * _ARROW_WIDTH,
        color=_color(ORANGE),
    )
    label = TextPrimitive(
        pose=Pose(position=top, orientation=Quaternion(w=1.0)),
        billboard=True,
        font_size=_FONT_SIZE,
        color=_color(ORANGE),
        text=str(number),
    )
    return SceneEntity(
        timestamp=stamp,
        frame_id=MAP,
        id=str(number),
        cylinders=[body],
        arrows=[arrow],
        texts=[label],
    )


def _cloud(
    stamp_ns: int, T: Float, points: NDArray[np.float32], p_static: NDArray[np.float32], color: Rgb
) -> PointCloud:
    rows = np.zeros(len(points), _POINT)
    rows["position"], rows["p_static"], rows["color"] = _lift(points), p_static, (*color, 255)
    kind = PackedElementFieldNumericType.Float32
    at = {name: offset for name, (_, offset, *_) in (_POINT.fields or {}).items()}
    fields = [(axis, at["position"] + 4 * k, kind) for k, axis in enumerate("xyz")]
    fields += [(name, at["color"] + k, type_) for name, k, type_ in _RGBA]
    return PointCloud(
        timestamp=to_timestamp(stamp_ns),
        frame_id=MAP,
        pose=to_pose(T),
        point_stride=_POINT.itemsize,
        fields=_fields([*fields, ("p_static", at["p_static"], kind)]),
        data=rows.tobytes(),
    )


def _fields(
    fields: list[tuple[str, int, PackedElementFieldNumericType]],
) -> list[PackedElementField]:
    return [PackedElementField(name=name, offset=k, type=kind) for name, k, kind in fields]


def _make_cells() -> NDArray[np.uint8]:
    """(256, 5) red, green, blue, alpha and per cent, by per cent."""
    percent = np.arange(256)
    grey = _FREE + (_OCCUPIED - _FREE) * np.minimum(percent, 100) / 100.0
    alpha = np.where(percent == UNKNOWN, 0, 255)
    return np.stack([grey, grey, grey, alpha, percent], axis=1).astype(np.uint8)


_CELLS = _make_cells()


def _lift(points: NDArray[np.floating]) -> NDArray[np.floating]:
    """(n, 3) points of (n, 2) or (n, 3)."""
    out = np.zeros((len(points), 3), points.dtype)
    out[:, : points.shape[1]] = points
    return out


def _vector(values: Float) -> Vector3:
    x, y, z = (*values.tolist(), 0.0)[:3]
    return Vector3(x=x, y=y, z=z)


def _translation(T: Float) -> Vector3:
    return _vector(T[:-1, -1])


def _rotation(T: Float) -> Quaternion:
    if len(T) == 3:
        half = 0.5 * math.atan2(T[1, 0], T[0, 0])
        return Quaternion(z=math.sin(half), w=math.cos(half))
    w, x, y, z = quaternion_from_pose(T).tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


def _color(rgb: Rgb, alpha: float = 1.0) -> Color:
    r, g, b = (one / 255.0 for one in rgb)
    return Color(r=r, g=g, b=b, a=alpha)
