"""The content of a result folder or a place as arrays, subsampled to what a browser can draw."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stillmap.core.array_types import Float, Float32
from stillmap.core.arrays import sample_indices
from stillmap.core.errors import InputError
from stillmap.core.json import read_json
from stillmap.core.recording import Recording
from stillmap.core.se2 import inverse
from stillmap.io.trajectory import read_tum
from stillmap.mapping.labelled_recording import sample_points
from stillmap.pipeline.snapshots import Window
from stillmap.results import gltf
from stillmap.results.objects import interpolate_pose
from stillmap.results.point_cloud import Part, cloud_from_folder
from stillmap.results.reader import SESSIONS, Grid, Track, is_place, read_grid, read_tracks
from stillmap.results.report.figures import UNKNOWN, draw_map, map_window
from stillmap.results.report.place import PlacePictures
from stillmap.results.timeline import Timeline, read_timeline
from stillmap.slam.deskew import deskew_recording
from stillmap.slam.options import SlamOptions

MAX_POINTS: dict[Part, int] = {"static": 500_000, "dynamic": 200_000}
_MAX_MESH = 512 << 20  # bytes of mesh.glb
_MAX_MODELS = 256 << 20  # bytes of all object models
_MAX_RECORD = 1 << 20  # bytes of objects/NNNN.json
_GROUND_QUANTILE = 0.05  # of the heights near the trajectory
_GROUND_RADIUS = 15.0  # m around the trajectory
_MIN_IMAGE_SIZE = 2_000  # pixels; browsers blur smaller images
MAX_BEAMS = 60_000  # shown of a scan
_BLOCK_SCANS = 256  # deskewed at once
_MAX_READ = 20_000_000  # beams read to find the dynamic ones, which takes seconds
# scans before and after one from which it is deskewed; in 2D several lasers may take turns
_NEIGHBORS = {2: 8, 3: 1}
Value = TypeVar("Value")


class Points(NamedTuple):
    """A point cloud.

    Attributes:
        points: (n, 3) float32 m, relative to the origin of the scene.
        colors: (n, 3) uint8; None where the file has none.
    """

    points: Float32
    colors: NDArray[np.uint8] | None


class MapImage(NamedTuple):
    """The 2D map as an image.

    Attributes:
        picture: (h, w, 4) uint8 RGBA, row 0 = highest y; in 3D transparent where unknown.
        window: x0, y0, x1, y1 in m, in the map frame.
    """

    picture: NDArray[np.uint8]
    window: Window


class Model(NamedTuple):
    """The mesh of a moving object: a .glb file, its track, and its pose (4, 4) in that."""

    data: bytes
    track: Track
    T_track_gltf: Float

    def pose_at(self, stamp_ns: int) -> Float:
        """T_map_gltf (4, 4) at a time, along the track."""
        return np.asarray(interpolate_pose(self.track, stamp_ns) @ self.T_track_gltf)


class Scene:
    """A result of T scans, or a place, read from its folder.

    Attributes:
        name: name of the recording.
        folder: name of the folder.
        stamp_ns: (T,).
        poses: (T, 4, 4) T_map_base.
        map_image: None for an empty map.
        clouds: by name of the layer, without empty ones; colors are those of pictures.
        tracks: moving objects.
        surface: mesh.glb; None where there is none.
        models: of the tracks that have one.
        origin: (3,) whole m in the map frame; everything is drawn relative to it.
        ground: height of the map image in m.
        is_2d: whether there are neither clouds nor a surface.
        notes: what cannot be shown, and why.
        timeline: of a place; None: a single result.
        pictures: of the map of a place; None for an empty one.
    """

    surface: bytes | None = None
    timeline: Timeline | None = None
    pictures: PlacePictures | None = None

    def __init__(self, folder: Path, recording: str = "") -> None:
        """Read a result or a place; optional files may be missing, unusable models are noted.

        Args:
            folder: the result, or the place.
            recording: name of its recording; that of the folder where it is empty.

        Raises:
            InputError: map or trajectory are missing, or a file is damaged.
        """
        grid, self.notes, self.folder = read_grid(folder), list[str](), folder.resolve().name
        self.name = recording or self.folder
        self.stamp_ns, self.poses = read_tum(folder / "trajectory.tum")
        if is_place(folder):
            self.timeline = read_timeline(folder)
            if any(one.scans.stop > len(self.poses) for one in self.timeline.sessions):
                what = "is damaged: its scans are not those of the place"
                raise InputError(what, where=str(folder / SESSIONS))
            self.pictures = PlacePictures(grid, self.timeline) if grid.p_occupied.size else None
        # near the scene: far away float32 would lose millimeters
        positions = self.poses[:, :3, 3]
        self.origin: Float = np.round(0.5 * (positions.min(axis=0) + positions.max(axis=0)))
        clouds = _read_clouds(folder, self.origin, self.notes)
        self.clouds = {name: one for name, one in clouds.items() if len(one.points)}
        self.tracks = read_tracks(folder / "objects" / "objects.json")
        if (folder / "mesh.glb").exists():
            path = folder / "mesh.glb"
            self.surface = _read_or_note(self.notes, gltf.read_glb, path, _MAX_MESH)
        self.map_image = _map_image(grid, self.pictures, transparent=bool(clouds))
        self.models = _read_models(folder / "objects", self.tracks, self.notes)
        self.ground = _ground(clouds.get("Static points"), self.poses, self.origin)
        self.is_2d = not clouds and self.surface is None


def _read_clouds(folder: Path, origin: Float, notes: list[str]) -> dict[str, Points]:
    """The clouds that a folder has, by name of their layer."""
    clouds = {}
    for part, most in MAX_POINTS.items():
        if (folder / f"{part}.ply").exists():
            cloud = cloud_from_folder(folder, part)
            block = cloud.sample(most)
            local = (block.points - origin).astype(np.float32)
            clouds[f"{part.capitalize()} points"] = Points(local, block.colors)
            if len(local) < cloud.count:
                notes.append(f"{len(local):,} of {cloud.count:,} {part} points are shown")
    return clouds


def _map_image(grid: Grid, pictures: PlacePictures | None, transparent: bool) -> MapImage | None:
    if not grid.p_occupied.size:
        return None
    window = map_window([grid]) if pictures is None else pictures.view.window
    drawn = draw_map(grid, window) if pictures is None else pictures.draw_map()
    return MapImage(to_rgba(drawn, transparent), window)


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


def _ground(static: Points | None, poses: Float, origin: Float) -> float:
    """Height of the floor in m, from the static points around the trajectory."""
    if static is None:
        return 0.0
    xy, way = static.points[:, :2], poses[:, :2, 3] - origin[:2]
    low, high = way.min(axis=0) - _GROUND_RADIUS, way.max(axis=0) + _GROUND_RADIUS
    z = static.points[((xy > low) & (xy < high)).all(axis=1), 2].astype(np.float64)
    return float(np.quantile(z, _GROUND_QUANTILE) + origin[2]) if len(z) else 0.0


def _read_models(folder: Path, tracks: list[Track], notes: list[str]) -> list[Model]:
    """The models of the longest tracks, up to `_MAX_MODELS` bytes."""
    models, left = list[Model](), _MAX_MODELS
    for track in sorted(tracks, key=lambda one: int(one.stamp_ns[0] - one.stamp_ns[-1])):
        path = folder / f"{track.id:04d}.glb"
        model = _read_or_note(notes, _read_model, path, track, left) if path.exists() else None
        if model is not None:
            models.append(model)
            left -= len(model.data)
    return models


def _read_model(path: Path, track: Track, max_bytes: int) -> Model:
    data, record_path = gltf.read_glb(path, max_bytes), path.with_suffix(".json")
    try:
        record = read_json(record_path, _MAX_RECORD)
        T = np.array(record["T_map_object"], np.float64).reshape(4, 4)
        then = interpolate_pose(track, int(record["stamp_ns"]))
        if not np.isfinite(T).all() or not math.isclose(np.linalg.det(T), 1.0, abs_tol=1e-3):
            raise ValueError("T_map_object is not a pose")
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise InputError(f"is damaged: {error!r}", where=str(record_path)) from error
    return Model(data, track, inverse(then) @ T @ gltf.MAP_FROM_GLTF)


def _read_or_note(notes: list[str], read: Callable[..., Value], *arguments: object) -> Value | None:
    """The value of `read(*arguments)`, or None with an InputError appended to `notes`."""
    try:
        return read(*arguments)
    except InputError as error:
        notes.append(str(error))
        return None


@dataclass(frozen=True, eq=False)
class Beams:
    """The recording of a result with labels and poses.

    Attributes:
        recording: T scans, M beams; may be memory-mapped.
        p_static: (M,) float32, P(c = 1), NaN for unusable beams.
        poses: (T, D+1, D+1) T_map_base.
        slam: options of deskewing.
    """

    recording: Recording
    p_static: Float32
    poses: Float
    slam: SlamOptions

    def scan_view(self, scan: int, max_count: int = MAX_BEAMS) -> tuple[Float, Float32, Float]:
        """At most `max_count` returns of a scan; reads only this scan and its neighbors.

        Returns:
            (n, 3) m, end points in the map frame, z = 0 in 2D; their P(static) (n,); and (3,) m,
            position of the sensor.
        """
        D, T = self.recording.dimension, self.recording.n_scans
        first, end = max(scan - _NEIGHBORS[D], 0), min(scan + _NEIGHBORS[D] + 1, T)
        scans = self.recording.slice_scans(first, end)
        near = deskew_recording(scans, self.poses[first:end], self.slam)
        beams, at = self.recording.beams_of(scan), near.beams_of(scan - first)
        use = np.flatnonzero(near.hit[at])
        use = use[sample_indices(len(use), max_count)]
        ends, origin = np.zeros((len(use), 3)), np.zeros(3)
        ends[:, :D] = near.end_points(at.start + use, self.poses[first:end])
        origin[:D] = near.T_map_sensor(self.poses[first:end])[scan - first, :D, D]
        p_static = np.asarray(self.p_static[beams][use])
        self.recording.release_pages(self.p_static)
        return ends, p_static, origin

    def dynamic_ends(self, max_count: int) -> Float:
        """At most `max_count` end points (n, D) in m, in the map frame, of dynamic returns.

        The recording is read in blocks of scans; of a long one not every block.
        """
        offset, T = self.recording.offset, self.recording.n_scans
        blocks = np.arange(0, T, _BLOCK_SCANS)
        most = max(1, _MAX_READ * len(blocks) // max(self.recording.n_beams, 1))
        parts = [np.zeros((0, self.recording.dimension))]
        for first in blocks[sample_indices(len(blocks), most)].tolist():
            end = min(first + _BLOCK_SCANS, T)
            poses, p_static = self.poses[first:end], self.p_static[offset[first] : offset[end]]
            block = deskew_recording(self.recording.slice_scans(first, end), poses, self.slam)
            parts.append(sample_points(block, poses, p_static, len(p_static)))
            self.recording.release_pages(self.p_static)
        ends = np.concatenate(parts)
        return ends[sample_indices(len(ends), max_count)]
