"""Readers of what scores are computed from: simulations, trajectories, relations, odometry."""

import logging
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stillmap.core import arrays, se2
from stillmap.core.array_folder import read_array
from stillmap.core.array_types import Bool, Float, Int64
from stillmap.core.errors import InputError
from stillmap.core.input_files import read_text
from stillmap.core.recording import Recording
from stillmap.io.carmen.log import CarmenLog, read_log
from stillmap.io.registry import RIG_FOLDERS
from stillmap.io.stillmap_folder import read as read_folder
from stillmap.io.text_lines import read_head
from stillmap.io.trajectory import MAX_BYTES, embed_in_3d, read_tum
from stillmap.results.reader import Labels


@dataclass(frozen=True, eq=False)
class Truth:
    """A simulated recording and its truth, whose arrays are read on demand."""

    folder: Path
    recording: Recording

    def static(self) -> Bool:
        """(M,) True where a static object reflected the beam; meaningful for hits."""
        return read_array(self.folder / "truth/static.npy", (self.recording.n_beams,), np.bool_)

    def walls(self) -> Float:
        """(W, 4) segments x0, y0, x1, y1 in the world frame, W >= 1; of planar recordings."""
        if self.recording.dimension != 2:
            raise InputError("is not a planar recording", where=str(self.folder))
        walls = self._read("walls", (None, 4))
        if not len(walls):
            raise InputError("holds no walls", where=str(self.folder / "truth/walls.npy"))
        return walls

    def lasting(self) -> Float:
        """(K, 4) segments of moved or added objects that are there at the end."""
        if not (self.folder / "truth/lasting.npy").exists():
            return np.empty((0, 4))
        return self._read("lasting", (None, 4))

    def poses(self) -> Float:
        """(T, D+1, D+1) T_world_base."""
        n = self.recording.dimension + 1
        return self._read("T_world_base", (self.recording.n_scans, n, n))

    def static_hits(self) -> Float:
        """(N, D) end points in the world frame, at true poses, of the static beams that hit."""
        use, recording = np.flatnonzero(self.recording.hit & self.static()), self.recording
        if (self.folder / "truth/T_base_sensor.npy").exists():  # it was wrong about its mount
            T_base_sensor = self._read("T_base_sensor", recording.T_base_sensor.shape)
            recording = replace(recording, T_base_sensor=T_base_sensor)
        return recording.end_points(use, self.poses())

    def _read(self, name: str, shape: tuple[int | None, ...]) -> Float:
        path = self.folder / "truth" / f"{name}.npy"
        array = read_array(path, shape, np.float64)
        if not np.isfinite(array).all():
            raise InputError("holds a number that is not finite", where=str(path))
        return array


def read_truth(path: Path, labels: Labels | None = None) -> Truth:
    """Read a simulated recording, given its folder or the `truth` folder inside.

    Args:
        path: the folder. Of a rig with two recordings, that of the flat laser is read.
        labels: of the two, the recording with these beams is read.

    Raises:
        InputError: it is not a simulation. The arrays of truth can still fail later.
    """
    folder = path.parent if path.name == "truth" and not (path / "truth").exists() else path
    if (folder / "truth").is_dir():
        return Truth(folder, read_folder(folder))
    inside = [path / name for name in RIG_FOLDERS]
    if not all((one / "truth").is_dir() for one in inside):
        hint = "a folder that 'stillmap simulate' wrote"
        raise InputError("holds no truth", where=str(path), hint=hint)
    if labels is None:
        return Truth(inside[0], read_folder(inside[0]))
    # both lasers may have equal stamps and numbers of beams; their hits differ
    both = [Truth(one, read_folder(one)) for one in inside]
    return max(both, key=lambda truth: _matching_share(labels, truth.recording))


def _matching_share(labels: Labels, recording: Recording) -> float:
    """Share of beams with equal hits; -1 if the numbers of beams differ."""
    if labels.hit.shape != recording.hit.shape:
        return -1.0
    blocks = arrays.iter_blocks(labels.hit, recording.hit)
    same = sum(int((labels.hit[b] == recording.hit[b]).sum()) for b in blocks)
    return same / max(len(labels.hit), 1)


def require_same_beams(labels: Labels, truth: Truth, result: Path) -> None:
    """Check that labels and truth are of the same beams.

    Raises:
        InputError: scans, beams or stamps differ.
    """
    where, hint = str(result / "beams"), "is it the result of another recording?"
    for name, got, wanted in (
        ("scans", len(labels.stamp_ns), truth.recording.n_scans),
        ("beams", len(labels.p_static), truth.recording.n_beams),
    ):
        if got != wanted:
            what = f"has {got} {name}, the truth in {truth.folder} has {wanted}"
            raise InputError(what, where=where, hint=hint)
    differ = labels.stamp_ns != truth.recording.stamp_ns
    differ |= labels.offset[1:] != truth.recording.offset[1:]
    if differ.any():
        what = f"scan {int(np.argmax(differ))} differs from that in {truth.folder}"
        raise InputError(what, where=where, hint=hint)


_RELATION = "t1 t2 x y z roll pitch yaw"

_POSE = "t x y theta, or stamp x y z qx qy qz qw"

_HEAD = 1 << 16  # bytes, of the lines before the first row

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses (N, 4, 4) at times (N,) in seconds, sorted by time, N >= 1."""

    stamp_s: Float
    poses: Float


def read_trajectory(path: Path) -> Trajectory:
    """Read rows `t x y theta` or TUM rows.

    Raises:
        InputError: the file cannot be read, or a line is not a pose.
    """
    if len(_first_row(path, _POSE)) == 4:
        rows = _rows(path, 4, "t x y theta")
        poses = embed_in_3d(se2.matrix(*rows[:, 1:].T))
        stamps = rows[:, 0]
    else:
        stamp_ns, poses = read_tum(path)
        stamps = to_seconds(stamp_ns)
    order = np.argsort(stamps, kind="stable")
    return Trajectory(stamps[order], poses[order])


def read_planar_trajectory(path: Path) -> Float:
    """Read a trajectory as (N, 4) t, x, y, theta; of 3D poses the yaw is taken."""
    trajectory = read_trajectory(path)
    T = trajectory.poses
    yaw = np.arctan2(T[:, 1, 0], T[:, 0, 0])
    return np.column_stack([trajectory.stamp_s, T[:, 0, 3], T[:, 1, 3], yaw])


def read_relations(path: Path) -> Float:
    """Read relations (R, 8): t1, t2, x, y, z, roll, pitch, yaw.

    Raises:
        InputError: the file cannot be read, or a line is not a relation.
    """
    return _rows(path, 8, _RELATION)


def read_odometry(path: Path) -> Float:
    """Read odometry (K, 4) t, x, y, theta of a CARMEN log, plain or gzip, or a trajectory file.

    Of a log the ODOM lines are read or, without any, the robot poses of its laser lines.

    Raises:
        InputError: the file cannot be read or holds no odometry.
    """
    if not _first_row(path, f"a CARMEN log or {_POSE}")[0][:1].isalpha():
        return read_planar_trajectory(path)
    log = read_log([path])
    if log.skipped_odometry.total:
        _log.warning("%s: odometry skipped: %s", path, log.skipped_odometry.summary())
    rows = _log_rows(log)
    if not len(rows):
        raise InputError("holds no odometry", where=str(path), hint="ODOM lines, or laser lines")
    return rows[np.argsort(rows[:, 0], kind="stable")]


def to_seconds(stamp_ns: Int64) -> Float:
    """The double nearest to each stamp, as if parsed from its decimal text.

    Dividing the array would round twice, which moves current stamps by up to 2e-7 s.
    """
    return np.array([stamp / 10**9 for stamp in stamp_ns.tolist()], np.float64)


def _log_rows(log: CarmenLog) -> Float:
    if len(log.odom_rows):
        stamps, poses = np.asarray(log.odom_rows)[1::2], np.asarray(log.odom_poses).reshape(-1, 3)
        return np.column_stack([to_seconds(stamps), poses])
    for laser in log.lasers.values():
        if len(laser.poses):
            poses = np.asarray(laser.poses).reshape(-1, 6)[:, 3:]
            stamps = np.asarray(laser.rows).reshape(len(laser), -1)[:, 1]
            return np.column_stack([to_seconds(stamps), poses])
    return np.zeros((0, 4))


def _first_row(path: Path, wanted: str) -> list[str]:
    """The words of the first row; # begins a comment."""
    text = read_head(path, _HEAD).decode("utf-8", "replace")
    for line in text.splitlines():
        if words := line.split("#")[0].split():
            return words
    raise InputError("holds no rows", where=str(path), hint=f"rows of {wanted}")


def _rows(path: Path, columns: int, names: str) -> Float:
    """(N, columns) finite numbers; # begins a comment."""
    rows = []
    for number, line in enumerate(read_text(path, MAX_BYTES).splitlines(), start=1):
        words = line.split("#")[0].split()
        try:
            row = [float(word) for word in words]
        except ValueError:
            row = []
        if words and (len(row) != columns or not all(map(math.isfinite, row))):
            what = f"is no row of {columns} finite numbers"
            raise InputError(what, where=f"{path}:{number}", hint=names)
        if words:
            rows.append(row)
    if not rows:
        raise InputError("holds no rows", where=str(path), hint=f"rows of {names}")
    return np.array(rows, np.float64)
