"""The files of a result folder read again; a place of several sessions has the same ones."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from stillmap.core import array_folder, se2
from stillmap.core.array_folder import parse, read_array
from stillmap.core.array_types import Bool, Float, Float32, Int64
from stillmap.core.arrays import iter_blocks
from stillmap.core.errors import InputError, explaining_damage
from stillmap.core.grid_map import GridMap
from stillmap.core.json import read_json
from stillmap.core.short_repr import ShortRepr
from stillmap.io.trajectory import MAX_TRANSLATION

Origin = tuple[float, float, float]

RECORD = "run.json"  # every result has it
SESSIONS = "sessions.json"  # every place of several sessions has it
EXTENDS = "extends_map"  # of the input: the result holds what still stands of a known map, too
LOCAL_ORIGIN = "local_origin"  # of the record, where it was not computed in the map frame
TILTING = "tilting"  # of the record, and the folder, of 3D data of a rig's tilting laser
HINT = "a result is what `stillmap map` or `merge` wrote"

# of map_server and nav2: what reads the map sees it as they load it
OCCUPIED_THRESH = 0.65
# map_server reads pixel 205 as p = 50 / 255 = 0.19608: any larger threshold turns unknown into free
FREE_THRESH = 0.196

_MIN_RESOLUTION, _MAX_RESOLUTION = 1e-4, 1e3  # m
_MAX_MAP = 1 << 29  # bytes of a map when it is unpacked: a thousand times what they take packed
_MAX_HITS = 1e30  # in a cell: single precision holds it
_ROWS = 256  # of a map that are checked at a time
_MAX_OBJECTS = 256 << 20  # bytes of an objects.json

Stamp = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]


class Grid(GridMap):
    """An occupancy map as stored in `map.npz`."""

    @property
    def occupied(self) -> Bool:
        return self.p_occupied > OCCUPIED_THRESH

    @property
    def free(self) -> Bool:
        return self.p_occupied < FREE_THRESH

    def cells(self, points: Float) -> Int64:
        """(N, 2) row and column of the cells that hold (N, 2) points; may lie outside the map."""
        T_grid_map = se2.inverse(se2.matrix(*self.origin))
        return np.floor(moved(T_grid_map, points) / self.resolution).astype(np.int64)[:, ::-1]

    def centres(self, cells: NDArray[np.integer | np.floating]) -> Float:
        """(N, 2) centres in the map frame of (N, 2) cells, row and column, or of parts of them."""
        return moved(se2.matrix(*self.origin), (cells[:, ::-1] + np.float64(0.5)) * self.resolution)


def moved(T: Float, points: Float) -> Float:
    return np.asarray(points @ T[:2, :2].T + T[:2, 2])


def require_there(*paths: Path) -> None:
    """Refuse folders that are not there.

    Raises:
        InputError: names the first of them.
    """
    for path in paths:
        if not path.is_dir():
            what = "is no folder" if path.exists() else "does not exist"
            raise InputError(what, where=str(path))


def is_result(path: Path) -> bool:
    """True if a folder is a result."""
    return (path / RECORD).is_file()


def is_place(path: Path) -> bool:
    """True if a folder is a place of several sessions, also one from which a file was taken."""
    marks = [path / one for one in (SESSIONS, "ties.npz")]
    return (path / "sessions").is_dir() and any(mark.is_file() for mark in marks)


# arrays


@dataclass(frozen=True, eq=False)
class Labels(ShortRepr):
    """`beams/` of a result of T scans with M beams.

    Attributes:
        stamp_ns: (T,) nanoseconds.
        offset: (T+1,) scan t owns the beams offset[t]:offset[t+1].
        p_static: (M,) P(c = 1); NaN: unusable.
        hit: (M,) whether the beam ended on something.
    """

    stamp_ns: Int64
    offset: Int64
    p_static: Float32
    hit: Bool


def read_labels(result: Path) -> Labels:
    """The labels of a result folder.

    Raises:
        InputError: files are missing, damaged, or of inconsistent lengths.
    """
    stamp_ns, offset, hit = read_beams(result)
    p_static = array_folder.read_probabilities(result / "beams" / "p_static.npy", len(hit))
    return Labels(stamp_ns, offset, p_static, hit)


def read_beams(result: Path) -> tuple[Int64, Int64, Bool]:
    """`stamp_ns`, `offset` and `hit` of `Labels`.

    Raises:
        InputError: files are missing, damaged, or of inconsistent lengths.
    """
    folder = result / "beams"
    stamp_ns = read_array(folder / "stamp_ns.npy", (None,), np.int64)
    offset = read_array(folder / "offset.npy", (len(stamp_ns) + 1,), np.int64)
    if offset[0] != 0 or np.any(offset[1:] < offset[:-1]):
        raise InputError("does not rise from 0", where=str(folder / "offset.npy"))
    return stamp_ns, offset, read_array(folder / "hit.npy", (int(offset[-1]),), np.bool_)


def read_colors(result: Path, beams: int) -> NDArray[np.uint8] | None:
    """(M, 3) colors of the end points of a result's beams; None where there are none.

    Raises:
        InputError: they are damaged, or of another number of beams.
    """
    path = result / "beams" / "colour.npy"
    return read_array(path, (beams, 3), np.uint8) if path.exists() else None


def read_grid(result: Path) -> Grid:
    """`map.npz` of a result folder; of a session of a place, that of the place.

    Raises:
        InputError: it is missing or damaged.
    """
    path = _find_map(result) / "map.npz"
    p_occupied, origin, resolution = _read_layer(path, "p_occupied", "f")
    if not _is_within(p_occupied, 1.0):
        raise InputError("p_occupied is no probability", where=str(path))
    return Grid(p_occupied.astype(np.float32, copy=False), origin, resolution)


def read_hit_sums(result: Path, shape: tuple[int, ...]) -> NDArray[np.floating[Any]]:
    """`alpha` (H, W) of the map that `read_grid` reads: sums of hits on what stands.

    Raises:
        InputError: it is missing or damaged, or of another shape.
    """
    path = _find_map(result) / "map.npz"
    alpha: NDArray[np.floating[Any]] = _read_layer(path, "alpha", "f")[0]
    if alpha.shape != shape or not _is_within(alpha, _MAX_HITS):
        raise InputError("alpha is no sum of hits for each cell", where=str(path))
    return alpha


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
    return Crossings(*_read_layer(path, "crossings", "iu"))


def _find_map(result: Path) -> Path:
    """The folder in which the map of a result lies: of a session of a place, that of the place."""
    home = Path(os.path.abspath(result)).parent
    is_session = home.name == "sessions" and (home.parent / SESSIONS).is_file()
    return home.parent if is_session else result


def _read_layer(path: Path, name: str, kinds: str) -> tuple[NDArray[Any], Origin, float]:
    """A layer (H, W) of one of these kinds of types, the origin (x, y, yaw) of its lower-left
    corner, and its resolution."""
    names = (name, "origin", "resolution")
    layer, origin, edge = array_folder.read_npz(path, names, _MAX_MAP).values()
    if layer.ndim != 2 or layer.dtype.kind not in kinds:
        hint = "maps are in the plane"
        raise InputError(f"{name} is {layer.shape} {layer.dtype}", where=str(path), hint=hint)
    with explaining_damage(path, TypeError):
        x, y, yaw = (float(value) for value in origin)
        resolution = float(edge)
    inside = np.abs((x, y, yaw)) < MAX_TRANSLATION
    if not (inside.all() and _MIN_RESOLUTION < resolution < _MAX_RESOLUTION):
        raise InputError("origin or resolution is no usable number", where=str(path))
    return layer, (x, y, yaw), resolution


# objects


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
    stamp_ns: Int64
    xy: Float
    velocity: Float
    z: Float | None = None
    beams: int | None = None
    p_dynamic: float | None = None
    session: str = ""
    p_identity: float | None = None


@dataclass(frozen=True)
class _Positions:
    """`track` of an entry of `objects.json`."""

    stamp_ns: list[Stamp]
    x: list[float]
    y: list[float]
    vx: list[float]
    vy: list[float]
    z: list[float] | None = None


@dataclass(frozen=True)
class _Object:
    """An entry of `objects.json`."""

    id: Annotated[int, Meta(ge=0, le=2**31 - 1)]  # as messages of ROS hold it
    size: Annotated[tuple[float, ...], Meta(min_length=2, max_length=3)]
    track: _Positions
    beams: int | None = None
    p_dynamic: float | None = None
    p_identity: float | None = None
    session: str = ""


def read_tracks(path: Path) -> list[Track]:
    """Reads the tracks of `objects.json`; empty where the file is missing.

    Raises:
        InputError: the file is damaged.
    """
    if not os.path.lexists(path):
        return []
    objects = parse(read_json(path, _MAX_OBJECTS), list[_Object], path)
    with explaining_damage(path):
        return [_to_track(one) for one in objects]


def _to_track(one: _Object) -> Track:
    track, stamp_ns = one.track, np.array(one.track.stamp_ns, np.int64)
    columns = [track.x, track.y, track.vx, track.vy, *([] if track.z is None else [track.z])]
    if {len(column) for column in columns} != {len(stamp_ns)} or not len(stamp_ns):
        raise ValueError("columns of unequal length, or empty ones")
    x, y, vx, vy, *z = np.array(columns, np.float64)
    if not (np.isfinite(columns).all() and np.isfinite(one.size).all()):
        raise ValueError("a number is not finite")
    if len(one.size) != 2 + len(z):
        raise ValueError(f"a size of {len(one.size)} lengths")
    xy, velocity = np.stack([x, y], axis=1), np.stack([vx, vy], axis=1)
    known = (one.beams, one.p_dynamic, one.session, one.p_identity)
    return Track(one.id, one.size, stamp_ns, xy, velocity, z[0] if z else None, *known)


# run.json


@dataclass(frozen=True)
class _Run:
    """The entries of `run.json` that are read."""

    input: dict[str, Any]
    options: dict[str, Any] | None = None
    warnings: list[str] | None = None
    quality: dict[str, float | None] | None = None
    dimension: int | None = None


def read_run(result: Path) -> dict[str, Any]:
    """The `run.json` of a result folder.

    Raises:
        InputError: it is missing or damaged.
    """
    path = result / RECORD
    record = array_folder.read_record(path, HINT)
    parse(record, _Run, path)
    return record
