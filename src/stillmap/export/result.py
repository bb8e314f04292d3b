"""A result folder read again, beside the recording that it was made from."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.errors import InputError
from stillmap.evaluation.folders import read_grid
from stillmap.evaluation.map import Grid
from stillmap.recording.model import Recording
from stillmap.recording.poses import poses_from_tum
from stillmap.texts import require_regular

_NUMBERS = ("x", "y", "vx", "vy")
_MAX_OBJECTS = 256 << 20  # bytes of an objects.json


@dataclass(frozen=True, eq=False)
class Track:
    """Something that moved.

    Attributes:
        id: its number.
        size: metres along and across its way; in space how high it is, too.
        stamp_ns: (K,) when it was seen, rising.
        xy: (K, 2) metres in the map frame.
        velocity: (K, 2) metres per second.
        z: (K,) metres, how high its middle is; None in the plane.
    """

    id: int
    size: tuple[float, ...]
    stamp_ns: NDArray[np.int64]
    xy: NDArray[np.float64]
    velocity: NDArray[np.float64]
    z: NDArray[np.float64] | None = None


@dataclass(frozen=True, eq=False)
class Exported:
    """What others are told of a result in the plane.

    Attributes:
        recording: T scans with M beams.
        poses: (T, 3, 3) T_map_base.
        p_static: (M,) float32, NaN for unusable beams.
        map: what stands still.
        tracks: what moved.
    """

    recording: Recording
    poses: NDArray[np.float64]
    p_static: NDArray[np.float32]
    map: Grid
    tracks: list[Track]


def read(folder: Path, recording: Recording, p_static: NDArray[np.float32]) -> Exported:
    """The result in `folder` of a recording, with its labels.

    Raises:
        InputError: a file is missing or damaged, or the recording is 3D.
    """
    if recording.dimension != 2:
        what = "is of a 3D recording: its points can be written, as a cloud"
        hint = ".las, .laz, .e57, .pcd, .ply or .xyz; .obj writes its model, if there is one"
        raise InputError(what, where=str(folder), hint=hint)
    return Exported(
        recording,
        poses_from_tum(folder / "trajectory.tum", recording),
        p_static,
        read_grid(folder),
        read_tracks(folder / "objects" / "objects.json"),
    )


def read_tracks(path: Path) -> list[Track]:
    """What moved, from `objects.json`; nothing where there is no such file.

    Raises:
        InputError: the file is damaged.
    """
    try:
        require_regular(path)
        if path.stat().st_size > _MAX_OBJECTS:
            raise InputError("is no list of objects: too large", where=str(path))
        return [_track(one) for one in json.loads(path.read_text(encoding="utf-8"))]
    except FileNotFoundError:
        return []
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=str(path)) from error
    except (ValueError, TypeError, KeyError, RecursionError, OverflowError) as error:
        raise InputError(f"is damaged: {error!r}", where=str(path)) from error


def _track(one: dict[str, Any]) -> Track:
    track = one["track"]
    stamp_ns = np.array(track["stamp_ns"], np.int64)
    x, y, vx, vy = (np.array(track[name], np.float64) for name in _NUMBERS)
    numbers = np.stack([x, y, vx, vy], axis=-1)
    z = np.array(track["z"], np.float64) if "z" in track else None
    size = tuple(float(metres) for metres in one["size"])
    if len(size) != (2 if z is None else 3):
        raise ValueError(f"a size of {len(size)} lengths")
    if len(numbers) != len(stamp_ns) or not len(stamp_ns) or (z is not None and z.shape != x.shape):
        raise ValueError("columns of unequal length")
    if not np.isfinite([*numbers.ravel(), *size, *([] if z is None else z)]).all():
        raise ValueError("a number is not finite")
    return Track(int(one["id"]), size, stamp_ns, numbers[:, :2], numbers[:, 2:], z)
