"""What a result folder shows, as arrays: read from its files, thinned to what a browser bears."""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from stillmap.core.errors import InputError
from stillmap.core.files import read_text
from stillmap.core.se2 import inverse
from stillmap.io.trajectory import read_tum
from stillmap.mesh.texture.atlas import GRAY
from stillmap.pipeline.snapshots import Window
from stillmap.results import gltf
from stillmap.results.reader import Track, read_grid, read_tracks
from stillmap.results.report.figures import ORANGE, UNKNOWN, draw_map, map_window
from stillmap.viewer import display
from stillmap.viewer.display import Points, sample_ply
from stillmap.viewer.tracks import interpolate_pose

MAX_POINTS = {"static": 500_000, "dynamic": 200_000}
_MOST_SURFACE = 512 << 20  # bytes of mesh.glb
_MOST_MODELS = 256 << 20  # bytes of the models of objects together
_MOST_PLACE = 1 << 20  # bytes of objects/NNNN.json
# m: beyond, float32 has no more millimetres, and all is shown around another origin
_FAR = 8_000.0
_GROUND = 0.05  # quantile of the heights near the way: walls reach up, holes are few
_NEAR = 15.0  # m
_SHARP = 2_000  # pixels along an edge of the plan: between them a browser draws what is blurred

Float = NDArray[np.float64]
Value = TypeVar("Value")


@dataclass(frozen=True, eq=False)
class MapImage:
    """The map from above.

    Attributes:
        picture: (h, w, 4) uint8 with an alpha channel, row 0 = highest y; in space clear where
            nothing is known.
        window: x0, y0, x1, y1 metres in the map frame.
    """

    picture: NDArray[np.uint8]
    window: Window


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points (n, 3) float32 around the scene's origin, their colours (n, 3) uint8, and of how many
    they were taken."""

    points: NDArray[np.float32]
    colors: NDArray[np.uint8]
    total: int


@dataclass(frozen=True, eq=False)
class Model:
    """What something that moved looks like.

    Attributes:
        data: the .glb file.
        T_map_gltf: (4, 4) where it stood, at `stamp_ns`.
        track: the way it goes.
    """

    data: bytes
    T_map_gltf: Float
    stamp_ns: int
    track: Track

    def pose_at(self, stamp_ns: int) -> Float:
        """(4, 4) T_map_gltf at another time: it goes and turns as its track does."""
        moved = interpolate_pose(self.track, stamp_ns) @ inverse(
            interpolate_pose(self.track, self.stamp_ns)
        )
        return np.asarray(moved @ self.T_map_gltf)


@dataclass(frozen=True, eq=False)
class Scene:
    """A result of T scans.

    Attributes:
        name: of its folder.
        stamp_ns: (T,).
        poses: (T, 4, 4) T_map_base.
        plan: None where nothing is known.
        clouds: by name, those that there are.
        tracks: what moved.
        surface: mesh.glb; None where there is none.
        models: those of `tracks` that have one.
        origin: (3,) whole metres in the map frame, around which everything is shown.
        ground: metres, how high the plan lies.
        notes: what cannot be shown, and why.
    """

    name: str
    stamp_ns: NDArray[np.int64]
    poses: Float
    map_image: MapImage | None
    clouds: dict[str, Cloud]
    tracks: list[Track]
    surface: bytes | None
    models: list[Model]
    origin: Float
    ground: float
    notes: list[str] = field(default_factory=list)

    @property
    def is_2d(self) -> bool:
        """Whether there is nothing but the plane."""
        return not self.clouds and self.surface is None


def read_scene(folder: Path) -> Scene:
    """What a result folder holds. What is missing is left out; models that cannot be shown are
    noted.

    Raises:
        InputError: map or trajectory are missing, or a file is damaged.
    """
    stamp_ns, poses = read_tum(folder / "trajectory.tum")
    origin = _origin(poses)
    raw = {
        name: sample_ply(folder / f"{name}.ply", most)
        for name, most in MAX_POINTS.items()
        if (folder / f"{name}.ply").exists()
    }
    tracks, notes = read_tracks(folder / "objects" / "objects.json"), list[str]()
    surface = _noted(notes, _surface, folder / "mesh.glb")
    models = _models(folder / "objects", tracks, notes)
    return Scene(
        name=folder.resolve().name,
        stamp_ns=stamp_ns,
        poses=poses,
        map_image=_plan(folder, clear=bool(raw)),
        clouds={name: _cloud(name, one, origin) for name, one in raw.items()},
        tracks=tracks,
        surface=surface,
        models=models,
        origin=origin,
        ground=_ground(raw.get("static"), poses),
        notes=notes,
    )


def _origin(poses: Float) -> Float:
    places = poses[:, :3, 3]
    if np.abs(places).max() < _FAR:
        return np.zeros(3)
    return np.asarray(np.round(0.5 * (places.min(axis=0) + places.max(axis=0))))


def _plan(folder: Path, clear: bool) -> MapImage | None:
    grid = read_grid(folder)
    if not grid.p_occupied.size:
        return None
    window = map_window([grid])
    picture = np.array(draw_map(grid, window).convert("RGBA"))
    if clear:  # no shade of grey is that of what is unknown
        picture[(picture[..., :3] == UNKNOWN).all(axis=2), 3] = 0
    larger = max(1, _SHARP // max(picture.shape))
    return MapImage(picture.repeat(larger, axis=0).repeat(larger, axis=1), window)


def _cloud(name: str, raw: Points, origin: Float) -> Cloud:
    painted = raw.colors
    if painted is None:
        painted = np.empty((len(raw.points), 3), np.uint8)
        painted[:] = ORANGE
        if name == "static" and len(raw.points):
            z = raw.points[:, 2]
            painted = display.color_by_height(z, *np.quantile(z, [0.02, 0.98]).tolist())
    elif name == "dynamic":  # grey would be taken for a part of the place
        painted[(painted == GRAY).all(axis=1)] = ORANGE
    return Cloud((raw.points - origin).astype(np.float32), painted, raw.total)


def _ground(static: Points | None, poses: Float) -> float:
    """How high the floor is along the way, by what stands around it."""
    if static is None or not len(static.points):
        return 0.0
    low, high = (f(poses[:, :2, 3], axis=0) for f in (np.min, np.max))
    near = ((static.points[:, :2] > low - _NEAR) & (static.points[:, :2] < high + _NEAR)).all(
        axis=1
    )
    z = static.points[near, 2]
    return float(np.quantile(z, _GROUND)) if len(z) else 0.0


def _surface(path: Path) -> bytes | None:
    return gltf.read_glb(path, _MOST_SURFACE) if path.exists() else None


def _models(folder: Path, tracks: list[Track], notes: list[str]) -> list[Model]:
    """Of those seen for longest first, as many as may be sent."""
    models, left = list[Model](), _MOST_MODELS
    for track in sorted(tracks, key=lambda one: int(one.stamp_ns[0] - one.stamp_ns[-1])):
        path = folder / f"{track.id:04d}.glb"
        if path.exists():
            model = _noted(notes, _model, path, track, left)
            if model is not None:
                models.append(model)
                left -= len(model.data)
    return models


def _model(path: Path, track: Track, most: int) -> Model:
    data = gltf.read_glb(path, most)
    place = path.with_suffix(".json")
    try:
        record = json.loads(read_text(place, _MOST_PLACE))
        T = np.array(record["T_map_object"], np.float64).reshape(4, 4)
        stamp_ns = int(record["stamp_ns"])
    except (ValueError, TypeError, KeyError, RecursionError, OverflowError) as error:
        raise InputError(f"is damaged: {error!r}", where=str(place)) from error
    if not np.isfinite(T).all() or not math.isclose(np.linalg.det(T), 1.0, abs_tol=1e-3):
        raise InputError("T_map_object is no pose", where=str(place))
    return Model(data, T @ gltf.MAP_FROM_GLTF, stamp_ns, track)


def _noted(notes: list[str], read: Callable[..., Value], *words: object) -> Value | None:
    """What cannot be shown is said, and the rest is."""
    try:
        return read(*words)
    except InputError as error:
        notes.append(str(error))
        return None
