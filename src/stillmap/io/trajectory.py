"""Poses as files write them: TUM trajectories (`stamp x y z qx qy qz qw`, stamps in s, exact to 1
ns), matrices, quaternions; poses at stamps."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stillmap.core import se2, se3
from stillmap.core.array_types import Bool, Float, Index, Int64
from stillmap.core.arrays import iter_blocks
from stillmap.core.errors import InputError
from stillmap.core.input_files import read_text
from stillmap.core.recording import Recording
from stillmap.core.timestamps import format_seconds, parse_ns

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

Number = TypeVar("Number", np.int64, np.float64)

MAX_BYTES = 128 << 20  # of a file: four hours at 100 Hz

_COLUMNS = "stamp x y z qx qy qz qw"

_BLOCK = 1 << 14  # poses written at once: Python floats take much memory
_UNIT_TOLERANCE = 0.02  # rotations and quaternions printed with three decimals deviate less

MAX_TRANSLATION = 1e9  # m
MAX_MOUNT = 1e5  # m from the robot's base to a sensor; the kernels' cells end at a few hundred km


def rigid_transform(R: ArrayLike, t: ArrayLike) -> Float:
    """(4, 4) transform of a rounded rotation (3, 3), projected onto SO(3), and a translation (m).

    Raises:
        ValueError: R is no rotation within the tolerance, or a number is not finite.
    """
    R, t = np.asarray(R, np.float64).reshape(3, 3), np.asarray(t, np.float64).reshape(3)
    if not (np.isfinite(R).all() and np.all(np.abs(t) < MAX_TRANSLATION)):
        raise ValueError("a pose is not finite")
    is_small = np.abs(R).max() <= 1.0 + _UNIT_TOLERANCE
    if not is_small or np.abs(R @ R.T - np.eye(3)).max() > _UNIT_TOLERANCE or np.linalg.det(R) < 0:
        raise ValueError("a pose has no rotation matrix")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    # an exact rotation stays bit-identical
    return T if np.array_equal(R @ R.T, np.eye(3)) else se3.normalize(T)


def is_rigid(T: Float, tolerance: float = _UNIT_TOLERANCE) -> Bool:
    """(N,) mask of the matrices (N, D+1, D+1) that are rigid transforms within a tolerance."""
    D = T.shape[-1] - 1
    with np.errstate(invalid="ignore", over="ignore"):
        is_near = (np.abs(T[:, :D, D]) < MAX_TRANSLATION).all(axis=1)
        is_bounded = (np.abs(T[:, :D, :D]) <= 1.0 + tolerance).all(axis=(1, 2))
        near = np.asarray(is_near & is_bounded)
        R = np.where(near[:, None, None], T[:, :D, :D], np.nan)
        skew = np.abs(R @ R.swapaxes(1, 2) - np.eye(D)).max(axis=(1, 2))
        is_affine = (np.abs(T[:, D] - np.eye(D + 1)[D]) <= tolerance).all(axis=1)
        return np.asarray((skew <= tolerance) & is_affine & (np.linalg.det(R) > 0.0))


def pose_from_row(row: ArrayLike) -> Float:
    """(4, 4) transform of its first three rows, 12 numbers.

    Raises:
        ValueError: see `rigid_transform`, or another count of numbers.
    """
    upper = np.asarray(row, np.float64).reshape(3, 4)
    return rigid_transform(upper[:, :3], upper[:, 3])


def pose_from_quaternion(wxyz: ArrayLike, t: ArrayLike) -> Float:
    """(4, 4) transform of a quaternion w x y z and a translation in metres.

    Raises:
        ValueError: the quaternion is not of norm one, or a number is not finite.
    """
    q = np.asarray(wxyz, np.float64)
    if not abs(np.linalg.norm(q) - 1.0) < _UNIT_TOLERANCE:
        raise ValueError("a quaternion is not of norm one")
    return rigid_transform(_rotations().from_quat(q[[1, 2, 3, 0]]).as_matrix(), t)


def quaternion_from_pose(T: Float) -> Float:
    """(..., 4) quaternions w x y z, w >= 0, of transforms (..., 4, 4)."""
    xyzw = _rotations().from_matrix(T[..., :3, :3]).as_quat(canonical=True)
    return np.asarray(xyzw)[..., [3, 0, 1, 2]]


def embed_in_3d(T: Float) -> Float:
    """(..., 4, 4) poses of (..., D+1, D+1); 2D poses lie at z = 0."""
    if T.shape[-1] == 4:
        return T
    out = np.zeros((*T.shape[:-2], 4, 4))
    out[..., :2, :2], out[..., :2, 3] = T[..., :2, :2], T[..., :2, 2]
    out[..., 2, 2] = out[..., 3, 3] = 1.0
    return out


def bracket_times(stamp_ns: Int64, at_ns: Int64) -> tuple[Index, Index, Float, Float]:
    """(n,) scans before and after given times (n,), the seconds between, and those since the first.

    Args:
        stamp_ns: (T,) of the scans, non-decreasing, T > 0; before and after them the outermost two
            count.
        at_ns: (n,).
    """
    last = len(stamp_ns) - 1
    before = np.searchsorted(stamp_ns, at_ns, side="right") - 1
    before = np.clip(before, 0, max(last - 1, 0))
    after: Index = np.minimum(before + 1, last)
    since, between = at_ns - stamp_ns[before], stamp_ns[after] - stamp_ns[before]
    return before, after, np.asarray(1e-9 * between), np.asarray(1e-9 * since)


def write_tum(path: Path, stamp_ns: Int64, poses: Float) -> None:
    """Write one line per pose.

    Args:
        path: the file.
        stamp_ns: (T,) int64 nanoseconds.
        poses: (T, D+1, D+1) float64, T_map_base, D = 2 or 3.
    """
    if len(stamp_ns) != len(poses):
        raise ValueError(f"poses: expected {len(stamp_ns)}, got {len(poses)}")
    with path.open("w", encoding="ascii", newline="\n") as file:
        for part in iter_blocks(poses, rows=_BLOCK):
            # + 0.0 turns negative zeros into zeros
            rows = np.round(pose_rows(poses[part]), 9) + 0.0
            for stamp, row in zip(stamp_ns[part].tolist(), rows.tolist(), strict=True):
                file.write(f"{format_seconds(stamp)} {' '.join(f'{value:.9f}' for value in row)}\n")


def read_tum(path: Path) -> tuple[Int64, Float]:
    """Stamps (T,) int64 in nanoseconds and poses (T, 4, 4) of a TUM file, in the file's order.

    Stamps are parsed as decimals, never as floats; digits beyond nanoseconds are rounded.
    Blank lines and lines that start with `#` are skipped.

    Raises:
        InputError: the file cannot be read, a line is no pose, or there is none.
    """
    stamps: list[int] = []
    rows: list[list[float]] = []
    for number, line in enumerate(read_text(path, MAX_BYTES).splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        stamp, row = _parse_pose(words, f"{path}:{number}")
        stamps.append(stamp)
        rows.append(row)
    if not stamps:
        raise InputError("holds no poses", where=str(path), hint=f"lines of '{_COLUMNS}'")
    return np.array(stamps, np.int64), poses_from_rows(np.array(rows))


def poses_from_rows(rows: Float) -> Float:
    """(T, 4, 4) of rows (T, 7) x y z qx qy qz qw.

    Raises:
        ValueError: a quaternion of length zero.
    """
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, 3] = rows[:, :3]
    poses[:, :3, :3] = _rotations().from_quat(rows[:, 3:]).as_matrix()
    return poses


def _rotations() -> "type[Rotation]":
    from scipy.spatial.transform import Rotation  # slow to load, and no need of 2D trajectories

    return Rotation


def pose_rows(poses: Float) -> Float:
    """(T, 7) x y z qx qy qz qw with qw >= 0."""
    rows = np.zeros((len(poses), 7))
    dimension = poses.shape[-1] - 1
    rows[:, :dimension] = poses[:, :dimension, dimension]
    if dimension == 2:
        half = np.arctan2(poses[:, 1, 0], poses[:, 0, 0]) / 2
        rows[:, 5], rows[:, 6] = np.sin(half), np.cos(half)
    elif len(poses):
        quaternion = _rotations().from_matrix(poses[:, :3, :3]).as_quat()
        rows[:, 3:] = np.where(quaternion[:, 3:] < 0, -quaternion, quaternion)
    return rows


def _parse_pose(words: list[str], where: str) -> tuple[int, list[float]]:
    try:
        stamp, row = parse_ns(words[0]), [float(word) for word in words[1:]]
    except ValueError:
        stamp, row = 0, []
    # plain Python: NumPy takes ten times as long for so few numbers
    is_pose = len(row) == 7 and all(map(math.isfinite, row))
    is_near = is_pose and max(map(abs, row[:3])) < MAX_TRANSLATION
    if not is_near or abs(math.hypot(*row[3:]) - 1) > _UNIT_TOLERANCE:
        hint = f"a line is '{_COLUMNS}' in seconds and metres, its quaternion of length one"
        raise InputError("is no pose", where=where, hint=hint)
    return stamp, row


def interpolate(stamp_ns: Int64, poses: Float, at_ns: Int64) -> tuple[Float, int]:
    """Interpolate poses: linear in x and y, along the shortest arc in theta.

    Args:
        stamp_ns: (N,) int64, N >= 1, in any order.
        poses: (N, 3) x, y in metres and theta in radians.
        at_ns: (T,) int64.

    Returns:
        (T, 3) poses, and the count of stamps outside the span of `stamp_ns`, which get the
        nearest pose.
    """
    order = np.argsort(stamp_ns, kind="stable")
    stamp_ns, poses = stamp_ns[order], poses[order]
    last = len(stamp_ns) - 1
    after = np.clip(np.searchsorted(stamp_ns, at_ns, side="right"), min(last, 1), last)
    before = np.maximum(after - 1, 0)
    span = (stamp_ns[after] - stamp_ns[before]).astype(float)
    share = (at_ns - stamp_ns[before]) / np.where(span > 0, span, 1.0)
    share = np.clip(share, 0.0, 1.0)[:, None]
    step = poses[after] - poses[before]
    step[:, 2] = se2.wrap(step[:, 2])
    outside = int(np.count_nonzero((at_ns < stamp_ns[0]) | (at_ns > stamp_ns[-1])))
    return poses[before] + share * step, outside


def describe_odometry(
    origin: str | None, outside: int, warnings: list[str]
) -> dict[str, str | int | None]:
    """Notes on odometry for `Source`; warns of scans outside its time."""
    if outside:
        warnings.append(f"{outside} scans outside the time of the odometry: nearest pose")
    return {"from": origin, "outside": outside}


_TOLERANCE_NS = 20_000_000  # other tools round stamps


def poses_from_tum(path: Path, recording: Recording) -> Float:
    """(T, D+1, D+1) T_map_base at the scans of a recording, from a TUM trajectory.

    A trajectory with exactly the stamps of the recording is used row by row (stamps may repeat);
    otherwise each scan gets the nearest pose within 20 ms.

    Raises:
        InputError: the file is no trajectory, or a scan has no pose.
    """
    stamp_ns, poses = read_tum(path)
    if recording.dimension == 2:
        poses = se2.project_to_plane(poses)
    if np.array_equal(stamp_ns, recording.stamp_ns):
        return poses
    order = np.argsort(stamp_ns, kind="stable")
    nearest = order[nearest_index(stamp_ns[order], recording.stamp_ns)]
    missing = np.flatnonzero(np.abs(stamp_ns[nearest] - recording.stamp_ns) > _TOLERANCE_NS)
    if len(missing):
        first = f"the first is scan {missing[0]} at {recording.stamp_ns[missing[0]] / 1e9:.3f} s"
        of = f"{len(missing)} of {recording.n_scans} scans"
        what = f"no pose within {_TOLERANCE_NS / 1e9:g} s of {of}, {first}"
        raise InputError(what, where=str(path))
    return poses[nearest]


def nearest_index(ordered: NDArray[Number], wanted: NDArray[Number]) -> Index:
    """(K,) index of the nearest of rising numbers (N,), N >= 1, to each one wanted (K,), such as
    stamps; of two equally near ones the earlier."""
    last = len(ordered) - 1
    right = np.clip(np.searchsorted(ordered, wanted), min(last, 1), last)
    left = np.maximum(right - 1, 0)
    closer_left = wanted - ordered[left] <= ordered[right] - wanted
    return np.where(closer_left, left, right)
