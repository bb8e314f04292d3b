"""Folders that scores are computed from: results of `stillmap map`, simulated recordings."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.arrays import open_npy
from stillmap.errors import InputError
from stillmap.evaluation.map import Grid
from stillmap.recording import spool
from stillmap.recording.folder import read as read_folder
from stillmap.recording.formats import RIG
from stillmap.recording.formats import read as recording_of
from stillmap.recording.model import Recording
from stillmap.texts import require_regular

MODEL = "mesh.glb"

_MAX_MAP = 1 << 29  # bytes of a map when it is unpacked: a thousand times what they take packed

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Labels:
    """`beams/` of a result: see the contract of `stillmap map`."""

    stamp_ns: NDArray[np.int64]
    offset: NDArray[np.int64]
    p_static: NDArray[np.float32]
    hit: Bool


@dataclass(frozen=True, eq=False)
class Truth:
    """A simulated recording and its truth. Arrays of truth are read when asked for."""

    folder: Path
    recording: Recording

    def static(self) -> Bool:
        """(M,) True where something static reflected the beam; meaningful where it hit."""
        return _array(self.folder / "truth/static.npy", (self.recording.n_beams,), "b")

    def walls(self) -> Float:
        """(W, 4) segments x0, y0, x1, y1 in the world frame, W >= 1; of planar recordings."""
        if self.recording.dimension != 2:
            raise InputError("is no planar recording", where=str(self.folder))
        path = self.folder / "truth/walls.npy"
        walls = _finite(path, _array(path, (None, 4), "f"))
        if not len(walls):
            raise InputError("holds no walls", where=str(path))
        return walls

    def lasting(self) -> Float:
        """(K, 4) the same of things that were moved or brought and are there at the end."""
        path = self.folder / "truth/lasting.npy"
        if not path.exists():
            return np.empty((0, 4))
        return _finite(path, _array(path, (None, 4), "f"))

    def poses(self) -> Float:
        """(T, D+1, D+1) T_world_base."""
        path = self.folder / "truth/T_world_base.npy"
        n = self.recording.dimension + 1
        return _finite(path, _array(path, (self.recording.n_scans, n, n), "f"))

    def static_hits(self) -> Float:
        """(N, D) end points in the world frame, at true poses, of the static beams that hit."""
        use = np.flatnonzero(self.recording.hit & self.static())
        return self.recording.end_points(use, self.poses())


def require_there(*paths: Path) -> None:
    """Refuse folders that are not there.

    Raises:
        InputError: names the first of them.
    """
    for path in paths:
        if not path.is_dir():
            what = "is no folder" if path.exists() else "does not exist"
            raise InputError(what, where=str(path))


def read_truth(path: Path, labels: Labels | None = None) -> Truth:
    """A simulated recording, given by its folder or by the `truth` folder inside.

    Args:
        path: the folder. Of one with the two recordings of a rig the flat laser's is taken.
        labels: of the two the one with their beams is taken.

    Raises:
        InputError: it is none. The arrays of truth can still fail later.
    """
    folder = path.parent if path.name == "truth" and not (path / "truth").exists() else path
    if (folder / "truth").is_dir():
        return _truth(folder)
    inside = [path / name for name in RIG]
    if not all((one / "truth").is_dir() for one in inside):
        raise InputError(
            "holds no truth", where=str(path), hint="a folder that 'stillmap simulate' wrote"
        )
    if labels is None:
        return _truth(inside[0])
    # both lasers may scan at the same times, as many beams each: where these ended differs
    return max(map(_truth, inside), key=lambda truth: _share_alike(labels, truth.recording))


def _truth(folder: Path) -> Truth:
    log = folder / "recording.log"  # a simulation in CARMEN's format
    return Truth(folder, recording_of(log) if log.exists() else read_folder(folder))


def _share_alike(labels: Labels, recording: Recording) -> float:
    """The share of beams that hit something in both, or in neither; -1 of other beams."""
    if labels.hit.shape != recording.hit.shape:
        return -1.0
    blocks = spool.blocks(labels.hit, recording.hit)
    same = sum(int((labels.hit[b] == recording.hit[b]).sum()) for b in blocks)
    return same / max(len(labels.hit), 1)


def read_labels(result: Path) -> Labels:
    """The labels of a result folder.

    Raises:
        InputError: they are missing, damaged, or of lengths that do not go together.
    """
    folder = result / "beams"
    stamp_ns = _array(folder / "stamp_ns.npy", (None,), "i")
    offset = _array(folder / "offset.npy", (len(stamp_ns) + 1,), "i")
    beams = int(offset[-1])
    path = folder / "p_static.npy"
    p_static = _array(path, (beams,), "f")
    for block in spool.blocks(p_static):
        wrong = np.flatnonzero((p_static[block] < 0) | (p_static[block] > 1))
        if len(wrong):
            beam = block.start + int(wrong[0])
            raise InputError(f"beam {beam} has no probability in [0, 1]", where=str(path))
    return Labels(stamp_ns, offset, p_static, _array(folder / "hit.npy", (beams,), "b"))


def require_model(result: Path) -> Path:
    """The model of the place in a result.

    Raises:
        InputError: there is none.
    """
    path = result / MODEL
    if not path.is_file():
        hint = "`stillmap map` makes them of 3D recordings, with pip install 'stillmap[mesh]'"
        raise InputError("holds no model", where=str(result), hint=hint)
    return path


def read_colours(result: Path, beams: int) -> NDArray[np.uint8] | None:
    """(M, 3) colours of the ends of a result's beams, so many; None where it has none.

    Raises:
        InputError: they are damaged, or others.
    """
    path = result / "beams" / "colour.npy"
    if not path.exists():
        return None
    colours = _array(path, (beams, 3), "u")
    if colours.dtype != np.uint8:
        raise InputError(f"holds {colours.dtype}", where=str(path))
    return colours


def require_same_beams(labels: Labels, truth: Truth, result: Path) -> None:
    """Labels and truth speak of the same beams.

    Raises:
        InputError: scans, beams or stamps differ.
    """
    for name, got, wanted in (
        ("scans", len(labels.stamp_ns), truth.recording.n_scans),
        ("beams", len(labels.p_static), truth.recording.n_beams),
    ):
        if got != wanted:
            raise InputError(
                f"has {got} {name}, the truth in {truth.folder} has {wanted}",
                where=str(result / "beams"),
                hint="is it the result of another recording?",
            )
    differ = labels.stamp_ns != truth.recording.stamp_ns
    differ |= labels.offset[1:] != truth.recording.offset[1:]
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
    require_regular(path)
    try:
        # opened here: given a path, np.load leaves a damaged archive open
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            size = archive.zip.getinfo("p_occupied.npy").file_size
            if size > _MAX_MAP:
                raise InputError(f"is too large: {size >> 20} MiB when unpacked", where=str(path))
            p_occupied = np.asarray(archive["p_occupied"])
            x, y, yaw = (float(value) for value in archive["origin"])
            resolution = float(archive["resolution"])
    except InputError:
        raise
    except OSError as error:
        raise InputError(_reason(error), where=str(path)) from error
    except Exception as error:  # whatever NumPy, zip and zlib make of damaged bytes
        raise InputError(f"is damaged: {error}", where=str(path)) from error
    if p_occupied.ndim != 2 or p_occupied.dtype.kind != "f":
        raise InputError(
            f"p_occupied is {_shown(p_occupied.shape)} {p_occupied.dtype}",
            where=str(path),
            hint="scores are for maps in the plane",
        )
    if not (np.isfinite((x, y, yaw)).all() and 0 < resolution < np.inf):
        raise InputError("origin or resolution is no usable number", where=str(path))
    return Grid(p_occupied, (x, y, yaw), resolution)


def _array(path: Path, shape: tuple[int | None, ...], kinds: str) -> NDArray[Any]:
    """An .npy array of this shape (None: any length) and one of these kinds of dtype."""
    array = open_npy(path)
    if len(array.shape) != len(shape) or any(
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
