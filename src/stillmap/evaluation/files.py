"""Text files that scores are computed from: trajectories, relations, odometry."""

import logging
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap import se2
from stillmap.errors import InputError
from stillmap.recording.carmen_log import CarmenLog, read_log
from stillmap.recording.lines import head
from stillmap.recording.tum import LARGEST, read_tum
from stillmap.texts import read_text, require_regular

Float = NDArray[np.float64]

_RELATION = "t1 t2 x y z roll pitch yaw"
_POSE = "t x y theta, or stamp x y z qx qy qz qw"
_HEAD = 1 << 16  # bytes: what stands before the first row

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses (N, 4, 4) at times (N,) in seconds, sorted by time, N >= 1."""

    stamp_s: Float
    poses: Float


def read_trajectory(path: Path) -> Trajectory:
    """Rows `t x y theta` or TUM rows, whichever the file holds.

    Raises:
        InputError: the file cannot be read, or a line of it is no pose.
    """
    if _first_row(path, _POSE).count == 4:
        rows = _rows(path, 4, "t x y theta")
        poses = np.tile(np.eye(4), (len(rows), 1, 1))
        T = se2.matrix(*rows[:, 1:].T)
        poses[:, :2, :2], poses[:, :2, 3] = T[:, :2, :2], T[:, :2, 2]
        stamps = rows[:, 0]
    else:
        stamp_ns, poses = read_tum(path)
        stamps = seconds(stamp_ns)
    order = np.argsort(stamps, kind="stable")
    return Trajectory(stamps[order], poses[order])


def read_planar(path: Path) -> Float:
    """The same file as (N, 4) t, x, y, theta; of a pose in space the yaw is taken."""
    trajectory = read_trajectory(path)
    T = trajectory.poses
    yaw = np.arctan2(T[:, 1, 0], T[:, 0, 0])
    return np.column_stack([trajectory.stamp_s, T[:, 0, 3], T[:, 1, 3], yaw])


def read_relations(path: Path) -> Float:
    """(R, 8) rows t1, t2, x, y, z, roll, pitch, yaw.

    Raises:
        InputError: the file cannot be read, or a line of it is no relation.
    """
    return _rows(path, 8, _RELATION)


def read_odometry(path: Path) -> Float:
    """(K, 4) t, x, y, theta of a CARMEN log, plain or gzip, or of a trajectory file.

    Of a log the ODOM lines count; where it has none, the robot poses of its laser lines do.

    Raises:
        InputError: the file cannot be read or holds no odometry.
    """
    if not _first_row(path, f"a CARMEN log or {_POSE}").is_log:
        return read_planar(path)
    log = read_log(path)
    if log.skipped_odometry.total:
        _log.warning("%s: odometry skipped: %s", path, log.skipped_odometry.summary())
    rows = _log_rows(log)
    if not len(rows):
        raise InputError("holds no odometry", where=str(path), hint="ODOM lines, or laser lines")
    return rows[np.argsort(rows[:, 0], kind="stable")]


def seconds(stamp_ns: NDArray[np.int64]) -> Float:
    """The double nearest to each stamp, as if parsed from its decimal text.

    Dividing the array would round twice, and move stamps of our century by up to 2e-7 s.
    """
    return np.array([stamp / 10**9 for stamp in stamp_ns.tolist()], np.float64)


def _log_rows(log: CarmenLog) -> Float:
    if len(log.odom_stamp_ns):
        stamps, poses = np.asarray(log.odom_stamp_ns), np.asarray(log.odom_poses).reshape(-1, 3)
        return np.column_stack([seconds(stamps), poses])
    for laser in log.lasers.values():
        if laser.has_poses:
            poses = np.asarray(laser.poses).reshape(-1, 6)[:, 3:]
            return np.column_stack([seconds(np.asarray(laser.stamp_ns)), poses])
    return np.zeros((0, 4))


@dataclass(frozen=True)
class _FirstRow:
    count: int
    is_log: bool


def _first_row(path: Path, wanted: str) -> _FirstRow:
    """What the first row looks like: how many columns, and whether it starts with a word."""
    require_regular(path)
    text = head(path, _HEAD).decode("utf-8", "replace")
    for line in text.splitlines():
        words = line.split("#")[0].split()
        if words:
            return _FirstRow(len(words), not _is_number(words[0]))
    raise InputError("holds no rows", where=str(path), hint=f"rows of {wanted}")


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _rows(path: Path, columns: int, names: str) -> Float:
    """(N, columns) finite numbers; what follows a # is a comment."""
    try:
        lines = read_text(path, LARGEST).splitlines()
    except UnicodeDecodeError as error:
        raise InputError("is not a text file", where=str(path)) from error
    rows = [
        _row(words, columns, names, f"{path}:{number}")
        for number, line in enumerate(lines, start=1)
        if (words := line.split("#")[0].split())
    ]
    if not rows:
        raise InputError("holds no rows", where=str(path), hint=f"rows of {names}")
    return np.array(rows, np.float64)


def _row(words: list[str], columns: int, names: str, where: str) -> list[float]:
    if len(words) != columns:
        raise InputError(f"has {len(words)} columns, not {columns}", where=where, hint=names)
    try:
        row = [float(word) for word in words]
    except ValueError as error:
        raise InputError("holds something that is no number", where=where, hint=names) from error
    if not all(math.isfinite(value) for value in row):
        raise InputError("holds a number that is not finite", where=where)
    return row
