"""Files of a folder, in order, and the times that their names may tell.

Hits of a recording for writers of clouds: scan by scan, or all in one frame.

Poses in space as other programs write them: rounded, as quaternions, as rows of numbers.
"""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
import scipy  # its parts load when they are first used
from numpy.typing import ArrayLike, NDArray

from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.core.timestamps import parse_ns

_NUMBER = re.compile(r"(?:^-)?\d+(?:\.\d+)?$")

_REPEATED = re.compile(r"(-?\d{19})_\d+")  # a second scan of one stamp, as we write it

_DIGITS_OF_NS = {19: 1, 16: 10**3, 13: 10**6}  # of ns, us, ms since 1970, or filled with zeros


def list_files(folder: Path, endings: tuple[str, ...]) -> list[Path]:
    """Files of a folder with such names in the order of the numbers in them; no hidden ones.

    Raises:
        InputError: the folder cannot be read.
    """
    try:
        entries = [e for e in folder.iterdir() if has_extension(e, endings) and not e.is_dir()]
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=str(folder)) from error
    return sorted(entries, key=lambda entry: (_natural(entry.name), entry.name))


def has_extension(path: Path, endings: tuple[str, ...]) -> bool:
    """Whether a file's name ends so, in small letters or large, and it is not hidden."""
    return path.name.lower().endswith(endings) and not path.name.startswith(".")


def contains_files(folder: Path, endings: tuple[str, ...]) -> bool:
    """Whether a folder has such files; False where it cannot be read."""
    try:
        return any(
            has_extension(entry, endings) and not entry.is_dir() for entry in folder.iterdir()
        )
    except OSError:
        return False


def require_nonempty_file(path: Path) -> None:
    """Refuse what is no file or holds nothing.

    Raises:
        InputError: see there.
    """
    try:
        if not path.is_file():
            what = "is no regular file" if path.exists() else "leads nowhere"
            raise InputError(what, where=str(path))
        if path.stat().st_size == 0:
            raise InputError("is empty", where=str(path))
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=str(path)) from error


def strip_extension(name: str, endings: tuple[str, ...]) -> str:
    """The name without its ending."""
    for ending in endings:
        if name.lower().endswith(ending):
            return name[: -len(ending)]
    return name


def stamps_from_names(stems: Sequence[str]) -> list[int] | None:
    """Nanoseconds, where all names end with a time of one kind; else None.

    Seconds have decimals; whole numbers have the digits of milli-, micro- or nanoseconds since
    1970, maybe with zeros before.
    """
    found = [_stamp(stem) for stem in stems]
    if not found or any(one is None for one in found):
        return None
    if len({kind for kind, _ in (one for one in found if one is not None)}) > 1:
        return None
    return [stamp for _, stamp in (one for one in found if one is not None)]


def _stamp(stem: str) -> tuple[int, int] | None:
    """Kind and nanoseconds."""
    repeated = _REPEATED.fullmatch(stem)
    text = repeated[1] if repeated else stem
    match = _NUMBER.search(text)
    if match is None:
        return None
    if "." in match[0]:
        try:
            return 0, parse_ns(match[0])
        except ValueError:
            return None
    scale = _DIGITS_OF_NS.get(len(match[0].lstrip("-")))
    if scale is None or not -(2**63) < int(match[0]) * scale < 2**63:
        return None
    return scale, int(match[0]) * scale


def _natural(name: str) -> list[tuple[int, int | str]]:
    """`scan10` comes after `scan9`."""
    parts = re.split(r"([0-9]+)", name)
    return [(1, int(part)) if i % 2 else (0, part) for i, part in enumerate(parts)]


_TOLERANCE = 0.02  # what three decimals leave of a rotation is well within it

_FAR = 1e9  # m


def rigid_transform(R: ArrayLike, t: ArrayLike) -> NDArray[np.float64]:
    """(4, 4) of a rotation (3, 3), as good as it was printed, and a translation (3,) in metres.

    Raises:
        ValueError: no rotation, or not finite.
    """
    R, t = np.asarray(R, np.float64).reshape(3, 3), np.asarray(t, np.float64).reshape(3)
    if not (np.isfinite(R).all() and np.all(np.abs(t) < _FAR)):
        raise ValueError("a pose is not finite")
    if np.abs(R @ R.T - np.eye(3)).max() > _TOLERANCE or np.linalg.det(R) < 0:
        raise ValueError("a pose does not turn as a body does")
    T = np.eye(4)
    # a rotation that is one to the last bit stays so
    T[:3, :3] = R if np.array_equal(R @ R.T, np.eye(3)) else _nearest(R)
    T[:3, 3] = t
    return T


def pose_from_row(row: ArrayLike) -> NDArray[np.float64]:
    """(4, 4) of the 12 numbers of its first three rows.

    Raises:
        ValueError: see `transform`; or another number of numbers.
    """
    upper = np.asarray(row, np.float64).reshape(3, 4)
    return rigid_transform(upper[:, :3], upper[:, 3])


def pose_from_quaternion(wxyz: ArrayLike, t: ArrayLike) -> NDArray[np.float64]:
    """(4, 4) of a quaternion, its real part first, and a translation in metres.

    Raises:
        ValueError: a quaternion that is not of length one, or not finite.
    """
    q = np.asarray(wxyz, np.float64)
    if not abs(np.linalg.norm(q) - 1.0) < _TOLERANCE:
        raise ValueError("a quaternion is not of length one")
    return rigid_transform(
        scipy.spatial.transform.Rotation.from_quat(q[[1, 2, 3, 0]]).as_matrix(), t
    )


def quaternion_from_pose(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 4) w x y z of (..., 4, 4), w not negative."""
    xyzw = scipy.spatial.transform.Rotation.from_matrix(T[..., :3, :3]).as_quat(canonical=True)
    return np.asarray(xyzw)[..., [3, 0, 1, 2]]


def embed_in_3d(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 4, 4) of poses (..., D+1, D+1); those of the plane lie at height 0."""
    if T.shape[-1] == 4:
        return T
    out = np.zeros((*T.shape[:-2], 4, 4))
    out[..., :2, :2], out[..., :2, 3] = T[..., :2, :2], T[..., :2, 2]
    out[..., 2, 2] = out[..., 3, 3] = 1.0
    return out


def _nearest(R: NDArray[np.float64]) -> NDArray[np.float64]:
    U, _, Vt = np.linalg.svd(R)
    nearest: NDArray[np.float64] = U @ Vt
    return nearest


_Number = TypeVar("_Number", np.float32, np.float64)

_BLOCK = 1 << 20  # beams placed together


def require_single_sensor(recording: Recording, where: str) -> None:
    """Refuse recordings of several sensors for formats that know of one.

    Raises:
        InputError: there are several.
    """
    n = len(recording.T_base_sensor)
    if n != 1:
        what = f"cannot be written: the recording has {n} sensors, the format one"
        raise InputError(what, where=where)


def sensor_poses(
    recording: Recording, T_map_base: NDArray[np.float64] | None
) -> NDArray[np.float64] | None:
    """(T, 4, 4) of the sensors, of robot poses (T, D+1, D+1); None for none."""
    return None if T_map_base is None else embed_in_3d(recording.T_map_sensor(T_map_base))


def scan_hits(
    recording: Recording, scan: int
) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """(n, 3) hits of a scan in the sensor's frame, and (n,) their times if there are any."""
    beams = recording.beams_of(scan)
    hit = recording.hit[beams]
    times = None if recording.beam_time is None else recording.beam_time[beams][hit]
    return _three(recording.points[beams][hit]), times


def iter_map_points(
    recording: Recording, T_map_base: NDArray[np.float64]
) -> Iterator[NDArray[np.float64]]:
    """All hits in the map frame, blocks (n, 3) in the recording's order.

    Args:
        recording: of any dimension; the plane lies at height 0.
        T_map_base: (T, D+1, D+1).
    """
    for start in range(0, recording.n_beams, _BLOCK):
        hit = start + np.flatnonzero(recording.hit[start : start + _BLOCK])
        yield _three(recording.end_points(hit, T_map_base))


def _three(points: NDArray[_Number]) -> NDArray[_Number]:
    if points.shape[1] == 3:
        return points
    return np.column_stack([points, np.zeros(len(points), points.dtype)])
