"""Folders of KITTI: odometry sequences (`velodyne/`, `times.txt`) and raw drives."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.errors import InputError
from stillmap.output.atomic import new_folder
from stillmap.recording import spin
from stillmap.recording.clouds import kitti_calibration, kitti_pictures, kitti_poses
from stillmap.recording.clouds.assembling import Cloud, Known, Source, assembled
from stillmap.recording.clouds.files import files_in, require_content
from stillmap.recording.clouds.kitti_times import read_times, rows_of
from stillmap.recording.clouds.placing import hits_of, one_sensor, sensor_poses
from stillmap.recording.clouds.records import cut_short
from stillmap.recording.lines import Progress
from stillmap.recording.model import Recording
from stillmap.recording.options import ReadOptions
from stillmap.recording.stamps import seconds_text

MARK = "times.txt"  # every such folder has it
_RECORD = 16  # bytes of a point: float32 x y z and reflectance
_RAW = Path("velodyne_points/data")
_LAYOUTS = (  # sweeps, their times
    (Path("velodyne"), Path("times.txt")),
    (_RAW, Path("velodyne_points/timestamps.txt")),
)


def is_one(path: Path) -> bool:
    """Whether a folder looks like one of KITTI."""
    return any((path / sweeps).is_dir() for sweeps, _ in _LAYOUTS)


def read(
    path: Path,
    options: ReadOptions,
    progress: Progress | None = None,
    scratch: Path | None = None,
) -> Recording:
    """Read an odometry sequence or a raw drive; the robot's base is its laser.

    KITTI has taken the motion out of the sweeps of its sequences, and not of its drives'. Their
    laser looks ahead at the stamp, and turns clockwise, whatever its manual says.

    Raises:
        InputError: there are no times, or no sweep can be read.
    """
    sweeps, times_file = next(one for one in _LAYOUTS if (path / one[0]).is_dir())
    files = files_in(path / sweeps, (".bin",))
    if not files:
        raise InputError("holds no sweep (*.bin)", where=str(path / sweeps))
    if not (path / times_file).is_file():
        hint = "one line for each sweep: its time in seconds"
        raise InputError("does not exist", where=str(path / times_file), hint=hint)
    times = read_times(path / times_file)
    rows = rows_of(files, len(times), path / times_file)
    calibration = kitti_calibration.find(path)
    poses, notes, by_line = kitti_poses.recorded(path, calibration, len(times), len(files))
    images, more = kitti_pictures.find(path, calibration, times)
    known = Known(path, "KITTI", [*calibration.warnings, *notes, *more])
    sources = []
    for number, (file, row) in enumerate(zip(files, rows, strict=True)):
        stamp_ns = None if row is None else times[row]
        at = row if by_line else number
        T = None if at is None else poses.get(at)
        cloud = partial(_sweep, file, T) if stamp_ns is not None else partial(_no_time, file)
        sources.append(Source(file.name, cloud, stamp_ns))
    recording = assembled(sources, known, options, progress, scratch, images=images)
    if options.spin_stamp is None:
        options = replace(options, spin_stamp=0.0)
    if options.spin == "auto" and sweeps == _RAW:
        options = replace(options, spin="clockwise")
    return spin.timed(recording, options)


def _sweep(path: Path, T: NDArray[np.float64] | None) -> Cloud:
    require_content(path)
    size = path.stat().st_size
    if size % _RECORD:
        raise cut_short(path, size // _RECORD, size // _RECORD + 1)
    return Cloud(np.fromfile(path, "<f4").reshape(-1, 4)[:, :3], T)


def _no_time(path: Path) -> Cloud:
    raise InputError("has no time", where=str(path))


def write(recording: Recording, path: str | Path, *, overwrite: bool = False) -> None:
    """Write an odometry sequence: the hits of each scan in the sensor's frame.

    The recorded poses, else the odometry, become `poses.txt`. It appears whole or not at all.

    Raises:
        InputError: `path` is taken or cannot be written to, or there are several sensors.
    """
    one_sensor(recording, str(path))
    T = recording.T_odom_base if recording.T_recorded_base is None else recording.T_recorded_base
    T = sensor_poses(recording, T)
    digits = max(6, len(str(recording.n_scans)))
    with new_folder(Path(path), MARK, overwrite) as folder:
        (folder / "velodyne").mkdir()
        for scan in recording.in_turn(range(recording.n_scans)):
            points, _ = hits_of(recording, scan)
            rows = np.zeros((len(points), 4), "<f4")
            rows[:, :3] = points
            rows.tofile(folder / "velodyne" / f"{scan:0{digits}d}.bin")
        stamps = (f"{seconds_text(stamp)}\n" for stamp in recording.stamp_ns.tolist())
        (folder / "times.txt").write_text("".join(stamps), encoding="ascii")
        identity = " ".join(f"{value:g}" for value in np.eye(4)[:3].ravel())
        (folder / "calib.txt").write_text(f"Tr: {identity}\n", encoding="ascii")
        if T is not None:
            rows_of_poses = (" ".join(f"{v:.17g}" for v in pose[:3].ravel()) for pose in T)
            text = "".join(f"{row}\n" for row in rows_of_poses)
            (folder / "poses.txt").write_text(text, encoding="ascii")
