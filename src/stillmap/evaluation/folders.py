"""Folders that scores are computed from: results of `stillmap map`, simulated recordings."""

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.errors import InputError
from stillmap.evaluation.map import Grid

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

_UNREADABLE = (ValueError, EOFError, KeyError, zipfile.BadZipFile)


@dataclass(frozen=True, eq=False)
class Labels:
    """`beams/` of a result: see the contract of `stillmap map`."""

    stamp_ns: NDArray[np.int64]
    offset: NDArray[np.int64]
    p_static: NDArray[np.float32]
    hit: Bool


@dataclass(frozen=True, eq=False)
class Truth:
    """A simulated recording folder with its truth, planar.

    Attributes:
        folder: where it was read from.
        stamp_ns: (T,) int64. offset: (T+1,) int64.
    """

    folder: Path
    stamp_ns: NDArray[np.int64]
    offset: NDArray[np.int64]

    def hit(self) -> Bool:
        """(M,) beams that something reflected."""
        return _array(self.folder / "hit.npy", (self._beams,), "b")

    def static(self) -> Bool:
        """(M,) True where something static reflected the beam; meaningful where hit."""
        return _array(self.folder / "truth/static.npy", (self._beams,), "b")

    def walls(self) -> Float:
        """(W, 4) segments x0, y0, x1, y1 in the world frame, W >= 1."""
        path = self.folder / "truth/walls.npy"
        walls = _finite(path, _array(path, (None, 4), "f"))
        if not len(walls):
            raise InputError("holds no walls", where=str(path))
        return walls

    def poses(self) -> Float:
        """(T, 3, 3) T_world_base."""
        path = self.folder / "truth/T_world_base.npy"
        return _finite(path, _array(path, (len(self.stamp_ns), 3, 3), "f"))

    def static_hits(self) -> Float:
        """(N, 2) end points in the world frame, at true poses, of the static beams."""
        use = np.flatnonzero(self.hit() & self.static())
        points = _array(self.folder / "points.npy", (self._beams, 2), "f")[use].astype(np.float64)
        scan = np.searchsorted(self.offset, use, side="right") - 1
        T = self._sensor_poses()[scan]
        world: Float = np.einsum("nij,nj->ni", T[:, :2, :2], points) + T[:, :2, 2]
        return world[np.isfinite(world).all(axis=1)]

    def _sensor_poses(self) -> Float:
        extrinsics = _array(self.folder / "T_base_sensor.npy", (None, 3, 3), "f")
        path = self.folder / "sensor.npy"
        sensor = _array(path, (len(self.stamp_ns),), "iu")
        if len(sensor) and not 0 <= sensor.min() <= sensor.max() < len(extrinsics):
            raise InputError(f"names a sensor beyond the {len(extrinsics)} there", where=str(path))
        return np.asarray(self.poses() @ extrinsics[sensor])

    @property
    def _beams(self) -> int:
        return int(self.offset[-1])


def read_truth(path: Path) -> Truth:
    """A simulated recording, given by its folder or by the `truth` folder inside.

    Raises:
        InputError: it is none. The arrays beyond stamps and offsets are read, and can fail, later.
    """
    folder = path.parent if path.name == "truth" and not (path / "truth").exists() else path
    if not (folder / "truth").is_dir():
        raise InputError(
            "holds no truth", where=str(path), hint="a folder that 'stillmap simulate' wrote"
        )
    return Truth(folder, *_scans(folder))


def read_labels(result: Path) -> Labels:
    """The labels of a result folder.

    Raises:
        InputError: they are missing, damaged, or of lengths that do not go together.
    """
    folder = result / "beams"
    stamp_ns, offset = _scans(folder)
    beams = int(offset[-1])
    path = folder / "p_static.npy"
    p_static = _array(path, (beams,), "f")
    with np.errstate(invalid="ignore"):
        wrong = np.flatnonzero((p_static < 0) | (p_static > 1))
    if len(wrong):
        raise InputError(f"beam {wrong[0]} has no probability in [0, 1]", where=str(path))
    return Labels(stamp_ns, offset, p_static, _array(folder / "hit.npy", (beams,), "b"))


def require_same_beams(labels: Labels, truth: Truth, result: Path) -> None:
    """Labels and truth speak of the same beams.

    Raises:
        InputError: scans, beams or stamps differ.
    """
    for name, got, wanted in (
        ("scans", len(labels.stamp_ns), len(truth.stamp_ns)),
        ("beams", int(labels.offset[-1]), int(truth.offset[-1])),
    ):
        if got != wanted:
            raise InputError(
                f"has {got} {name}, the truth in {truth.folder} has {wanted}",
                where=str(result / "beams"),
                hint="is it the result of another recording?",
            )
    differ = (labels.stamp_ns != truth.stamp_ns) | (labels.offset[1:] != truth.offset[1:])
    if differ.any():
        raise InputError(
            f"scan {int(np.argmax(differ))} is another one than in {truth.folder}",
            where=str(result / "beams"),
            hint="is it the result of another recording?",
        )


def read_grid(result: Path) -> Grid:
    """`map.npz` of a result folder.

    Raises:
        InputError: it is missing or damaged.
    """
    path = result / "map.npz"
    try:
        with np.load(path, allow_pickle=False) as archive:
            p_occupied, origin, resolution = (
                archive[name] for name in ("p_occupied", "origin", "resolution")
            )
    except OSError as error:
        raise InputError(_reason(error), where=str(path)) from error
    except (*_UNREADABLE, AttributeError, TypeError) as error:
        raise InputError("is damaged or no map of stillmap", where=str(path)) from error
    if p_occupied.ndim != 2 or p_occupied.dtype.kind != "f" or origin.shape != (3,):
        raise InputError(
            f"p_occupied {p_occupied.shape}, origin {origin.shape}: expected (H, W) and (3,)",
            where=str(path),
            hint="scores are for maps in the plane",
        )
    if resolution.shape != () or not (np.isfinite(origin).all() and 0 < resolution < np.inf):
        raise InputError("origin or resolution is no usable number", where=str(path))
    x, y, yaw = (float(value) for value in origin)
    return Grid(p_occupied, (x, y, yaw), float(resolution))


def _scans(folder: Path) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    stamp_ns = _array(folder / "stamp_ns.npy", (None,), "i")
    path = folder / "offset.npy"
    offset = _array(path, (len(stamp_ns) + 1,), "i")
    if offset[0] != 0 or np.any(np.diff(offset) < 0):
        raise InputError("offsets do not rise from 0", where=str(path))
    return stamp_ns, offset


def _array(path: Path, shape: tuple[int | None, ...], kinds: str) -> NDArray[Any]:
    """An .npy array of this shape (None: any length) and one of these kinds of dtype."""
    try:
        array: NDArray[Any] = np.load(path, mmap_mode="r", allow_pickle=False)
    except OSError as error:
        raise InputError(_reason(error), where=str(path)) from error
    except _UNREADABLE as error:
        raise InputError("is damaged or no .npy file", where=str(path)) from error
    fits = isinstance(array, np.ndarray) and len(array.shape) == len(shape)
    if not fits or any(
        want not in (None, got) for got, want in zip(array.shape, shape, strict=True)
    ):
        raise InputError(f"is {_shown(array.shape)}, not {_shown(shape)}", where=str(path))
    if array.dtype.kind not in kinds:
        raise InputError(f"holds {array.dtype}", where=str(path))
    return array


def _finite(path: Path, array: NDArray[Any]) -> Float:
    if not np.isfinite(array).all():
        raise InputError("holds a number that is not finite", where=str(path))
    return np.asarray(array, np.float64)


def _shown(shape: tuple[int | None, ...]) -> str:
    return f"({', '.join('any' if n is None else str(n) for n in shape)})"


def _reason(error: OSError) -> str:
    return f"cannot be read: {error.strerror or error}"
