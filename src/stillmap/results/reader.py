"""A result folder read again, beside the recording that it was made from."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.array_folder import read_npz
from stillmap.core.arrays import iter_blocks
from stillmap.core.errors import InputError, install_command
from stillmap.core.grid_map import GridMap
from stillmap.core.json import read_json
from stillmap.core.short_repr import ShortRepr
from stillmap.results.labels import shape_text

Float = NDArray[np.float64]
Origin = tuple[float, float, float]


# of map_server and nav2: what reads the map sees it as they load it
OCCUPIED_THRESH = 0.65
# map_server reads pixel 205 as p = 50 / 255 = 0.19608: any larger threshold turns unknown into free
FREE_THRESH = 0.196


class Grid(GridMap):
    """An occupancy map as stored in `map.npz`."""

    @property
    def occupied(self) -> NDArray[np.bool_]:
        return self.p_occupied > OCCUPIED_THRESH

    @property
    def free(self) -> NDArray[np.bool_]:
        return self.p_occupied < FREE_THRESH

    def cells(self, points: Float) -> NDArray[np.int64]:
        """(N, 2) row and column of the cells that hold (N, 2) points; may lie outside the map."""
        T_grid_map = se2.inverse(se2.matrix(*self.origin))
        return np.floor(moved(T_grid_map, points) / self.resolution).astype(np.int64)[:, ::-1]

    def centres(self, cells: NDArray[np.integer | np.floating]) -> Float:
        """(N, 2) centres in the map frame of (N, 2) cells, row and column, or of parts of them."""
        return moved(se2.matrix(*self.origin), (cells[:, ::-1] + np.float64(0.5)) * self.resolution)


SESSIONS = "sessions.json"  # every place has it
_MAX_ORIGIN = 1e9  # m, farther than any map projection has
_MIN_RESOLUTION, _MAX_RESOLUTION = 1e-4, 1e3  # m
_ROWS = 256  # of a map that are checked at a time
_MAX_HITS = 1e30  # in a cell: single precision holds it
_MAX_MAP = 1 << 29  # bytes of a map when it is unpacked: a thousand times what they take packed


def require_there(*paths: Path) -> None:
    """Refuse folders that are not there.

    Raises:
        InputError: names the first of them.
    """
    for path in paths:
        if not path.is_dir():
            what = "is no folder" if path.exists() else "does not exist"
            raise InputError(what, where=str(path))


def require_model(result: Path) -> Path:
    """The model of the place in a result.

    Raises:
        InputError: there is none.
    """
    path = result / "mesh.glb"
    if not path.is_file():
        hint = f"mesh.enabled=true makes them of 3D recordings, with {install_command('mesh')}"
        raise InputError("holds no model", where=str(result), hint=hint)
    return path


def _find_map(result: Path) -> Path:
    """The folder in which the map of a result lies: of a session of a place, that of the place."""
    home = Path(os.path.abspath(result)).parent
    is_session = home.name == "sessions" and (home.parent / SESSIONS).is_file()
    return home.parent if is_session else result


def read_grid(result: Path) -> Grid:
    """`map.npz` of a result folder; of a session of a place, that of the place.

    Raises:
        InputError: it is missing or damaged.
    """
    path = _find_map(result) / "map.npz"
    p_occupied, origin, resolution = _read_layer(path, "p_occupied")
    if p_occupied.ndim != 2 or p_occupied.dtype.kind != "f":
        raise InputError(
            f"p_occupied is {shape_text(p_occupied.shape)} {p_occupied.dtype}",
            where=str(path),
            hint="scores are for maps in the plane",
        )
    if not is_probability(p_occupied):
        raise InputError("p_occupied is no probability", where=str(path))
    return Grid(p_occupied.astype(np.float32, copy=False), origin, resolution)


def read_hit_sums(result: Path, shape: tuple[int, ...]) -> NDArray[np.floating[Any]]:
    """`alpha` of the map that `read_grid` reads: (H, W) sums of hits on what stands.

    Args:
        result: the folder.
        shape: of the map.

    Raises:
        InputError: it is missing or damaged.
    """
    path = _find_map(result) / "map.npz"
    alpha: NDArray[np.floating[Any]] = _read_layer(path, "alpha")[0]
    if alpha.shape != shape or alpha.dtype.kind != "f":
        what = f"alpha is {shape_text(alpha.shape)} {alpha.dtype}, p_occupied {shape_text(shape)}"
        raise InputError(what, where=str(path))
    if not is_hit_sum(alpha):
        raise InputError("alpha is no sum of hits", where=str(path))
    return alpha


def is_probability(layer: NDArray[np.floating[Any]]) -> bool:
    """True if all values that are not NaN are from 0 to 1."""
    return _is_within(layer, 1.0)


def is_hit_sum(layer: NDArray[np.floating[Any]]) -> bool:
    """True if all values that are not NaN can be sums of hits in a cell."""
    return _is_within(layer, _MAX_HITS)


def _is_within(layer: NDArray[np.floating[Any]], limit: float) -> bool:
    """True if all values that are not NaN are from 0 to a limit."""
    return not any(
        ((layer[rows] < 0.0) | (layer[rows] > limit)).any()
        for rows in iter_blocks(layer, rows=_ROWS)
    )


class Crossings(NamedTuple):
    """Number of crossings of each square of the floor.

    Attributes:
        number: (H, W) integers; row 0 has the lowest y.
        origin: x, y (m) and yaw of the lower-left corner of the lower-left square.
        resolution: m, edge of a square.
    """

    number: NDArray[np.integer[Any]]
    origin: Origin
    resolution: float


def read_crossings(result: Path) -> Crossings:
    """The crossings in `traffic.npz` of a result folder; of a session of a place, all of the place.

    Raises:
        InputError: it is missing or damaged.
    """
    path = _find_map(result) / "traffic.npz"
    if not path.exists():
        hint = "`stillmap map` writes it with objects.enabled=true"
        raise InputError("does not exist: no crossings were counted", where=str(path), hint=hint)
    crossings = Crossings(*_read_layer(path, "crossings"))
    number = crossings.number
    if number.ndim != 2 or number.dtype.kind not in "iu":
        raise InputError(f"crossings is {shape_text(number.shape)} {number.dtype}", where=str(path))
    return crossings


def _read_layer(path: Path, name: str) -> tuple[NDArray[Any], Origin, float]:
    """A layer of a map, the origin (x, y, yaw) of its lower-left corner, and its resolution."""
    layer, origin, edge = read_npz(path, (name, "origin", "resolution"), _MAX_MAP).values()
    try:
        x, y, yaw = (float(value) for value in origin)
        resolution = float(edge)
    except (TypeError, ValueError) as error:
        raise InputError(f"is damaged: {error}", where=str(path)) from error
    inside = np.abs((x, y, yaw)) < _MAX_ORIGIN
    if not (inside.all() and _MIN_RESOLUTION < resolution < _MAX_RESOLUTION):
        raise InputError("origin or resolution is no usable number", where=str(path))
    return layer, (x, y, yaw), resolution


def moved(T: Float, points: Float) -> Float:
    return np.asarray(points @ T[:2, :2].T + T[:2, 2])


_MAX_OBJECTS = 256 << 20  # bytes of an objects.json
_MAX_ID = 2**31 - 1  # as messages of ROS hold it


@dataclass(frozen=True, eq=False)
class Track(ShortRepr):
    """Something that moved.

    Attributes:
        id: its number.
        size: metres along and across its way; in space how high it is, too.
        stamp_ns: (K,) when it was seen, rising.
        xy: (K, 2) metres in the map frame.
        velocity: (K, 2) metres per second.
        z: (K,) metres, how high its middle is; None in the plane.
        beams: how many fell on it; None where the file does not say.
        p_dynamic: their mean P(dynamic); None likewise.
        session: of a place, in which it was seen; empty otherwise.
        p_identity: P that it is one mover all the time; None where the file does not say.
    """

    id: int
    size: tuple[float, ...]
    stamp_ns: NDArray[np.int64]
    xy: NDArray[np.float64]
    velocity: NDArray[np.float64]
    z: NDArray[np.float64] | None = None
    beams: int | None = None
    p_dynamic: float | None = None
    session: str = ""
    p_identity: float | None = None


def read_tracks(path: Path) -> list[Track]:
    """Reads the tracks of `objects.json`; empty where the file is missing.

    Raises:
        InputError: the file is damaged.
    """
    if not os.path.lexists(path):
        return []
    try:
        return [_track(one) for one in read_json(path, _MAX_OBJECTS)]
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise InputError(f"is damaged: {error!r}", where=str(path)) from error


def _track(one: dict[str, Any]) -> Track:
    track = one["track"]
    stamp_ns = np.array(track["stamp_ns"], np.int64)
    x, y, vx, vy = (np.array(track[name], np.float64) for name in ("x", "y", "vx", "vy"))
    numbers = np.stack([x, y, vx, vy], axis=-1)
    z = np.array(track["z"], np.float64) if "z" in track else None
    size = tuple(float(metres) for metres in one["size"])
    if len(size) != (2 if z is None else 3):
        raise ValueError(f"a size of {len(size)} lengths")
    if len(numbers) != len(stamp_ns) or not len(stamp_ns) or (z is not None and z.shape != x.shape):
        raise ValueError("columns of unequal length")
    if not np.isfinite([*numbers.ravel(), *size, *([] if z is None else z)]).all():
        raise ValueError("a number is not finite")
    if not 0 <= int(one["id"]) <= _MAX_ID:
        raise ValueError(f"an id of {one['id']}")
    beams = None if one.get("beams") is None else int(one["beams"])
    p_dynamic = None if one.get("p_dynamic") is None else float(one["p_dynamic"])
    p_identity = None if one.get("p_identity") is None else float(one["p_identity"])
    xy, velocity, session = numbers[:, :2], numbers[:, 2:], str(one.get("session", ""))
    known = (beams, p_dynamic, session, p_identity)
    return Track(int(one["id"]), size, stamp_ns, xy, velocity, z, *known)
