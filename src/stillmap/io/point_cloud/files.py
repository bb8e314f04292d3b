"""Files of scan folders and their stamps, poses as numbers, and hits for writers."""

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.core.timestamps import parse_ns
from stillmap.io.point_cloud.signatures import iter_files
from stillmap.io.text_lines import read_lines

_NUMBER = re.compile(r"(?:^-)?\d+(?:\.\d+)?$")

_REPEATED = re.compile(r"(-?\d{19})_\d+")  # a further scan of the same stamp, as pcd.write names it

_DATE = re.compile(r"(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)(\.\d+)?")

_NS_BY_DIGITS = {19: 1, 16: 10**3, 13: 10**6}  # digits of ns, us, ms since 1970


def list_files(folder: Path, extensions: tuple[str, ...]) -> list[Path]:
    """Visible files of a folder with one of the extensions, in natural order.

    Raises:
        InputError: the folder cannot be read.
    """
    try:
        entries = list(iter_files(folder, extensions))
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=str(folder)) from error
    return sorted(entries, key=lambda entry: (_natural_key(entry.name), entry.name))


def require_nonempty_file(path: Path) -> None:
    """Refuse paths that are no regular file, and empty files.

    Raises:
        InputError: the path is neither readable nor a non-empty file.
    """
    try:
        if not path.is_file():
            what = "is no regular file" if path.exists() else "does not exist"
            raise InputError(what, where=str(path))
        if path.stat().st_size == 0:
            raise InputError("is empty", where=str(path))
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=str(path)) from error


@contextmanager
def library_errors(path: Path) -> Iterator[None]:
    """Turn errors of a library about damaged bytes into InputError."""
    try:
        with np.errstate(all="ignore"):
            yield
    except (InputError, MemoryError):
        raise
    except BaseException as error:
        # panics of Rust derive from BaseException
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        raise damaged_error(path, error) from error


def damaged_error(path: Path, error: BaseException) -> InputError:
    """The error for a file on which a library fails."""
    what = (str(error).splitlines() or [type(error).__name__])[0]
    return InputError(f"is damaged: {what}", where=str(path))


def strip_extension(name: str, extensions: tuple[str, ...]) -> str:
    """The name without its extension."""
    for extension in extensions:
        if name.lower().endswith(extension):
            return name[: -len(extension)]
    return name


def stamps_from_names(stems: Sequence[str]) -> list[int] | None:
    """Stamps in nanoseconds where all names end with a time of one unit; else None.

    Numbers with decimals are seconds; integers of 13, 16 or 19 digits are milli-, micro- or
    nanoseconds since 1970.
    """
    found = [one for stem in stems if (one := _parse_stamp(stem)) is not None]
    if len(found) < len(stems) or len({unit for unit, _ in found}) != 1:
        return None
    return [stamp for _, stamp in found]


def _parse_stamp(stem: str) -> tuple[int, int] | None:
    """Unit (0: decimal seconds) and nanoseconds; None: no time."""
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
    scale = _NS_BY_DIGITS.get(len(match[0].lstrip("-")))
    if scale is None or not -(2**63) < int(match[0]) * scale < 2**63:
        return None
    return scale, int(match[0]) * scale


def read_times(path: Path) -> list[int | None]:
    """Read a stamp (ns) per line, of seconds or of a date and time; None where unreadable.

    Dates are taken as UTC.

    Raises:
        InputError: the file cannot be read.
    """
    out: list[int | None] = []
    for line in read_lines(path):
        out.append(_parse_line(line.text.decode("ascii", "replace").strip()))
    end = len(out)
    while end and out[end - 1] is None:
        end -= 1
    return out[:end]


def _parse_line(text: str) -> int | None:
    date = _DATE.fullmatch(text)
    try:
        if date is None:
            return parse_ns(text)
        at = datetime.fromisoformat(date[1]).replace(tzinfo=UTC)
        whole = parse_ns(str(int(at.timestamp())))  # refuses years beyond int64 ns
        return whole + parse_ns(f"0{date[2] or '.0'}")
    except (ValueError, OverflowError):
        return None


def assign_rows(files: Sequence[Path], rows: int, where: Path) -> list[int | None]:
    """Index of the line that belongs to each file; None: there is none.

    File names that are numbers are line indices (scans may be missing); otherwise there must be as
    many files as lines.

    Raises:
        InputError: neither holds.
    """
    numbers = [int(f.stem) if re.fullmatch(r"[0-9]{1,18}", f.stem) else -1 for f in files]
    are_indices = all(number >= 0 for number in numbers) and len(set(numbers)) == len(numbers)
    if len(files) == rows and not (are_indices and max(numbers, default=0) < rows):
        return list(range(rows))
    if not are_indices or numbers[0] >= rows:
        what = f"has {rows} stamps for {len(files)} files whose names are no line numbers"
        raise InputError(what, where=str(where))
    return [number if number < rows else None for number in numbers]


def _natural_key(name: str) -> list[tuple[int, int | str]]:
    """Sort key by which `scan10` follows `scan9`."""
    parts = re.split(r"([0-9]+)", name)
    return [(1, int(part)) if i % 2 else (0, part) for i, part in enumerate(parts)]


_TOLERANCE = 0.02  # rotations printed with three decimals deviate less

MAX_TRANSLATION = 1e9  # m


def rigid_transform(R: ArrayLike, t: ArrayLike) -> NDArray[np.float64]:
    """(4, 4) transform of a rounded rotation (3, 3), projected onto SO(3), and a translation (m).

    Raises:
        ValueError: R is no rotation within the tolerance, or a number is not finite.
    """
    R, t = np.asarray(R, np.float64).reshape(3, 3), np.asarray(t, np.float64).reshape(3)
    if not (np.isfinite(R).all() and np.all(np.abs(t) < MAX_TRANSLATION)):
        raise ValueError("a pose is not finite")
    if np.abs(R @ R.T - np.eye(3)).max() > _TOLERANCE or np.linalg.det(R) < 0:
        raise ValueError("a pose has no rotation matrix")
    if not np.array_equal(R @ R.T, np.eye(3)):  # an exact rotation stays bit-identical
        U, _, Vt = np.linalg.svd(R)
        R = U @ Vt
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def pose_from_row(row: ArrayLike) -> NDArray[np.float64]:
    """(4, 4) transform of its first three rows, 12 numbers.

    Raises:
        ValueError: see `rigid_transform`, or another count of numbers.
    """
    upper = np.asarray(row, np.float64).reshape(3, 4)
    return rigid_transform(upper[:, :3], upper[:, 3])


def pose_from_quaternion(wxyz: ArrayLike, t: ArrayLike) -> NDArray[np.float64]:
    """(4, 4) transform of a quaternion w x y z and a translation in metres.

    Raises:
        ValueError: the quaternion is not of norm one, or a number is not finite.
    """
    q = np.asarray(wxyz, np.float64)
    if not abs(np.linalg.norm(q) - 1.0) < _TOLERANCE:
        raise ValueError("a quaternion is not of norm one")
    from scipy.spatial.transform import Rotation  # slow to load

    return rigid_transform(Rotation.from_quat(q[[1, 2, 3, 0]]).as_matrix(), t)


def quaternion_from_pose(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 4) quaternions w x y z, w >= 0, of transforms (..., 4, 4)."""
    from scipy.spatial.transform import Rotation

    xyzw = Rotation.from_matrix(T[..., :3, :3]).as_quat(canonical=True)
    return np.asarray(xyzw)[..., [3, 0, 1, 2]]


def embed_in_3d(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 4, 4) poses of (..., D+1, D+1); 2D poses lie at z = 0."""
    if T.shape[-1] == 4:
        return T
    out = np.zeros((*T.shape[:-2], 4, 4))
    out[..., :2, :2], out[..., :2, 3] = T[..., :2, :2], T[..., :2, 2]
    out[..., 2, 2] = out[..., 3, 3] = 1.0
    return out


_BLOCK = 1 << 20  # beams transformed at once


def require_single_sensor(recording: Recording, where: str) -> None:
    """Refuse recordings of several sensors, for formats that hold one.

    Raises:
        InputError: there are several sensors.
    """
    n = len(recording.T_base_sensor)
    if n != 1:
        what = f"cannot be written: the recording has {n} sensors, the format holds one"
        raise InputError(what, where=where)


def sensor_poses(
    recording: Recording, T_map_base: NDArray[np.float64] | None
) -> NDArray[np.float64] | None:
    """(T, 4, 4) sensor poses of robot poses (T, D+1, D+1); None for None."""
    return None if T_map_base is None else embed_in_3d(recording.T_map_sensor(T_map_base))


def scan_hits(
    recording: Recording, scan: int
) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """(n, 3) hits of a scan in the sensor frame, and their times (n,) or None."""
    beams = recording.beams_of(scan)
    hit = recording.hit[beams]
    times = None if recording.beam_time is None else recording.beam_time[beams][hit]
    return _to_3d(recording.points[beams][hit]), times


def iter_map_points(
    recording: Recording, T_map_base: NDArray[np.float64]
) -> Iterator[NDArray[np.float64]]:
    """Yield all hits in the map frame in blocks (n, 3), in recording order.

    Args:
        recording: 2D hits lie at z = 0.
        T_map_base: (T, D+1, D+1).
    """
    for start in range(0, recording.n_beams, _BLOCK):
        hit = start + np.flatnonzero(recording.hit[start : start + _BLOCK])
        yield _to_3d(recording.end_points(hit, T_map_base))


def _to_3d(points: NDArray[Any]) -> NDArray[Any]:
    if points.shape[1] == 3:
        return points
    return np.column_stack([points, np.zeros(len(points), points.dtype)])
