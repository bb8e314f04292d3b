"""The content of a result folder or a place as arrays, subsampled to what a browser can draw."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stillmap.core.errors import InputError
from stillmap.core.json import read_json
from stillmap.core.se2 import inverse
from stillmap.io.trajectory import read_tum
from stillmap.pipeline.snapshots import Window
from stillmap.results import gltf
from stillmap.results.object_poses import interpolate_pose
from stillmap.results.point_cloud import Cloud, Part, cloud_from_folder
from stillmap.results.reader import SESSIONS, Grid, Track, is_place, read_grid, read_tracks
from stillmap.results.report.figures import UNKNOWN, draw_map, map_window
from stillmap.results.report.place_pictures import PlacePictures
from stillmap.results.timeline import Timeline, read_timeline

Float = NDArray[np.float64]
MAX_POINTS: dict[Part, int] = {"static": 500_000, "dynamic": 200_000}
_MAX_MESH = 512 << 20  # bytes of mesh.glb
_MAX_MODELS = 256 << 20  # bytes of all object models
_MAX_RECORD = 1 << 20  # bytes of objects/NNNN.json
_MAX_COORDINATE = 8_000.0  # m; beyond it float32 loses millimeters, and the origin is shifted
_GROUND_QUANTILE = 0.05  # of the heights near the trajectory
_GROUND_RADIUS = 15.0  # m around the trajectory
_MIN_IMAGE_SIZE = 2_000  # pixels; browsers blur smaller images
Value = TypeVar("Value")


@dataclass(frozen=True, eq=False)
class Points:
    """A subsampled point cloud.

    Attributes:
        points: (n, 3) m in the map frame.
        colors: (n, 3) uint8; None where the file has none.
        total: number of points in the file.
    """

    points: NDArray[np.floating]
    colors: NDArray[np.uint8] | None
    total: int


@dataclass(frozen=True, eq=False)
class ViewedPlace:
    """A place of several sessions.

    Attributes:
        timeline: the sessions in the order of time, and what changed between them.
        pictures: of the map; None for an empty one.
    """

    timeline: Timeline
    pictures: PlacePictures | None

    def __len__(self) -> int:
        return len(self.timeline.sessions)

    def scans_of(self, session: int) -> range:
        """Indices of the scans of a session in the scene."""
        scans = self.timeline.sessions[session].scans
        return range(scans.start, scans.stop)


@dataclass(frozen=True, eq=False)
class MapImage:
    """The 2D map as an image.

    Attributes:
        picture: (h, w, 4) uint8 RGBA, row 0 = highest y; in 3D transparent where unknown.
        window: x0, y0, x1, y1 in m, in the map frame.
    """

    picture: NDArray[np.uint8]
    window: Window


@dataclass(frozen=True, eq=False)
class Model:
    """The mesh of a moving object.

    Attributes:
        data: the .glb file.
        T_map_gltf: (4, 4) pose at `stamp_ns`.
        track: its track.
    """

    data: bytes
    T_map_gltf: Float
    stamp_ns: int
    track: Track

    def pose_at(self, stamp_ns: int) -> Float:
        """T_map_gltf (4, 4) at another time, along the track."""
        now, then = (interpolate_pose(self.track, at) for at in (stamp_ns, self.stamp_ns))
        return np.asarray(now @ inverse(then) @ self.T_map_gltf)


@dataclass(frozen=True, eq=False)
class Scene:
    """A result of T scans.

    Attributes:
        name: name of the recording.
        folder: name of the folder.
        stamp_ns: (T,).
        poses: (T, 4, 4) T_map_base.
        map_image: None for an empty map.
        clouds: by name: `static`, `dynamic`; float32, relative to `origin`. Colors are those of
            pictures; None where there are none.
        tracks: moving objects.
        surface: mesh.glb; None where there is none.
        models: of the tracks that have one.
        origin: (3,) whole m in the map frame; everything is drawn relative to it.
        ground: height of the map image in m.
        notes: what cannot be shown, and why.
        place: the sessions of a place; None: a single result.
    """

    name: str
    folder: str
    stamp_ns: NDArray[np.int64]
    poses: Float
    map_image: MapImage | None
    clouds: dict[Part, Points]
    tracks: list[Track]
    surface: bytes | None
    models: list[Model]
    origin: Float
    ground: float
    notes: list[str] = field(default_factory=list)
    place: ViewedPlace | None = None

    @property
    def is_2d(self) -> bool:
        """True if there are neither clouds nor a mesh."""
        return not self.clouds and self.surface is None


def read_scene(folder: Path, recording: str = "") -> Scene:
    """Read a result folder or a place; optional files may be missing, unusable models are noted.

    Args:
        folder: the result, or the place.
        recording: name of its recording; that of the folder where it is empty.

    Raises:
        InputError: map or trajectory are missing, or a file is damaged.
    """
    place, grid = None, read_grid(folder)
    stamp_ns, poses = read_tum(folder / "trajectory.tum")
    if is_place(folder):
        timeline = read_timeline(folder)
        if any(one.scans.stop > len(poses) for one in timeline.sessions):
            what = "is damaged: its scans are not those of the place"
            raise InputError(what, where=str(folder / SESSIONS))
        pictures = PlacePictures(grid, timeline) if grid.p_occupied.size else None
        place = ViewedPlace(timeline, pictures)
    origin = _origin(poses)
    raw = {
        part: _sample(cloud_from_folder(folder, part), most)
        for part, most in MAX_POINTS.items()
        if (folder / f"{part}.ply").exists()
    }
    tracks, notes = read_tracks(folder / "objects" / "objects.json"), list[str]()
    surface = None
    if (folder / "mesh.glb").exists():
        surface = _read_or_note(notes, gltf.read_glb, folder / "mesh.glb", _MAX_MESH)
    models = _models(folder / "objects", tracks, notes)
    return Scene(
        name=recording or folder.resolve().name,
        folder=folder.resolve().name,
        stamp_ns=stamp_ns,
        poses=poses,
        map_image=_map_image(grid, place, transparent=bool(raw)),
        clouds={
            name: Points((one.points - origin).astype(np.float32), one.colors, one.total)
            for name, one in raw.items()
        },
        tracks=tracks,
        surface=surface,
        models=models,
        origin=origin,
        ground=_ground(raw.get("static"), poses),
        notes=notes,
        place=place,
    )


def _sample(cloud: Cloud, most: int) -> Points:
    block = cloud.sample(most)
    return Points(block.points, block.colors, cloud.count)


def _origin(poses: Float) -> Float:
    positions = poses[:, :3, 3]
    if np.abs(positions).max() < _MAX_COORDINATE:
        return np.zeros(3)
    return np.asarray(np.round(0.5 * (positions.min(axis=0) + positions.max(axis=0))))


def _map_image(grid: Grid, place: ViewedPlace | None, transparent: bool) -> MapImage | None:
    if not grid.p_occupied.size:
        return None
    if place is not None and place.pictures is not None:
        last = place.pictures.draw(len(place) - 1)
        return MapImage(to_rgba(last, transparent), place.pictures.view.window)
    window = map_window([grid])
    return MapImage(to_rgba(draw_map(grid, window), transparent), window)


def to_rgba(drawn: Image.Image, transparent: bool) -> NDArray[np.uint8]:
    """(h, w, 4) of a drawn map, large enough for browsers.

    Args:
        drawn: the map.
        transparent: where it is unknown.
    """
    picture = np.array(drawn.convert("RGBA"))
    if transparent:
        picture[(picture[..., :3] == UNKNOWN).all(axis=2), 3] = 0
    scale = max(1, _MIN_IMAGE_SIZE // max(picture.shape))
    return picture.repeat(scale, axis=0).repeat(scale, axis=1)


def _ground(static: Points | None, poses: Float) -> float:
    """Height of the floor in m, from the static points around the trajectory."""
    if static is None or not len(static.points):
        return 0.0
    xy, way = static.points[:, :2], poses[:, :2, 3]
    low, high = way.min(axis=0) - _GROUND_RADIUS, way.max(axis=0) + _GROUND_RADIUS
    z = static.points[((xy > low) & (xy < high)).all(axis=1), 2]
    return float(np.quantile(z, _GROUND_QUANTILE)) if len(z) else 0.0


def _models(folder: Path, tracks: list[Track], notes: list[str]) -> list[Model]:
    """The models of the longest tracks, up to `_MAX_MODELS` bytes."""
    models, left = list[Model](), _MAX_MODELS
    for track in sorted(tracks, key=lambda one: int(one.stamp_ns[0] - one.stamp_ns[-1])):
        path = folder / f"{track.id:04d}.glb"
        if path.exists():
            model = _read_or_note(notes, _model, path, track, left)
            if model is not None:
                models.append(model)
                left -= len(model.data)
    return models


def _model(path: Path, track: Track, max_bytes: int) -> Model:
    data = gltf.read_glb(path, max_bytes)
    record_path = path.with_suffix(".json")
    try:
        record = read_json(record_path, _MAX_RECORD)
        T = np.array(record["T_map_object"], np.float64).reshape(4, 4)
        stamp_ns = int(record["stamp_ns"])
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise InputError(f"is damaged: {error!r}", where=str(record_path)) from error
    if not np.isfinite(T).all() or not math.isclose(np.linalg.det(T), 1.0, abs_tol=1e-3):
        raise InputError("T_map_object is not a pose", where=str(record_path))
    return Model(data, T @ gltf.MAP_FROM_GLTF, stamp_ns, track)


def _read_or_note(notes: list[str], read: Callable[..., Value], *arguments: object) -> Value | None:
    """The value of `read(*arguments)`, or None with an InputError appended to `notes`."""
    try:
        return read(*arguments)
    except InputError as error:
        notes.append(str(error))
        return None
