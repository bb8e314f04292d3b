"""KITTI folders: odometry sequences (`velodyne/`, `times.txt`), raw drives, and their poses."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import scipy  # its parts load when they are first used
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.core.files import atomic_folder
from stillmap.core.input_files import read_bytes
from stillmap.core.recording import Recording
from stillmap.core.timestamps import format_seconds
from stillmap.io.builder import ReadContext, part_context
from stillmap.io.parts.joining import join_recordings
from stillmap.io.point_cloud import kitti_cameras
from stillmap.io.point_cloud.binary_table import iter_text_lines, parse_numbers, truncated_error
from stillmap.io.point_cloud.hits import require_single_sensor, scan_hits, sensor_poses
from stillmap.io.point_cloud.kitti_cameras import Calibration, find_images
from stillmap.io.point_cloud.origin import place_clouds
from stillmap.io.point_cloud.scans import Cloud, CloudSource, DatasetInfo, build_recording, reject
from stillmap.io.rigid_transforms import pose_from_row, rigid_transform
from stillmap.io.scan_files import assign_rows, list_files, read_times, require_nonempty_file
from stillmap.prepare.beam_times import STAMP_AZIMUTH_KEY, add_beam_times
from stillmap.prepare.time_window import TimeWindow, select_time

Poses = list[NDArray[np.float64]]

_EARTH = 6378137.0  # m

_STAMP_AZIMUTH = 0.0  # rad: the laser faces ahead at the stamp

_MAX_POSES = 10_000_000  # of a file


def read_poses(
    folder: Path, calibration: Calibration, lines: int, files: int
) -> tuple[dict[int, NDArray[np.float64]], list[str], bool]:
    """Read the laser poses of a folder.

    Args:
        folder: the recording.
        calibration: extrinsics of cameras and IMU.
        lines: count of stamps.
        files: count of scans.

    Returns:
        T_map_laser (4, 4) by number from 0, warnings, and whether numbers count stamps, not files.
    """
    try:
        poses, name = _read_pose_file(folder, calibration)
    except InputError as error:
        return {}, [f"poses are ignored: {error}"], True
    if len(poses) not in (0, lines, files):
        return {}, [f"poses are ignored: {name} has {len(poses)} for {files} scans"], True
    return dict(enumerate(poses)), [], len(poses) == lines


def _read_pose_file(folder: Path, calibration: Calibration) -> tuple[Poses, str]:
    if (folder / "poses_lidar.txt").is_file():
        return _read_rows(folder / "poses_lidar.txt"), "poses_lidar.txt"
    if (folder / "poses.txt").is_file():
        T = calibration.T_camera_laser
        if T is None:
            raise InputError("they are camera poses, and there is no calib.txt with its extrinsics")
        return [se2.inverse(T) @ P @ T for P in _read_rows(folder / "poses.txt")], "poses.txt"
    if (folder / "oxts" / "data").is_dir():
        if calibration.T_laser_imu is None:
            raise InputError("there is no calib_imu_to_velo.txt with the extrinsics of the IMU")
        T = se2.inverse(calibration.T_laser_imu)
        return [P @ T for P in _read_oxts(folder / "oxts" / "data")], "oxts"
    return [], ""


def _read_rows(path: Path) -> Poses:
    numbers = parse_numbers(iter_text_lines(path), _MAX_POSES, range(12), path)
    out = []
    for i, row in enumerate(numbers):
        try:
            out.append(pose_from_row(row))
        except ValueError as error:
            raise InputError(str(error), where=f"{path}:{i + 1}") from error
    return out


def _read_oxts(folder: Path) -> Poses:
    """T_map_imu of files of latitude, longitude (degrees), height (m), roll, pitch, yaw (rad).

    East, north and up from the first pose, in the Mercator projection that is to scale there.
    """
    out: Poses = []
    scale = first = None
    for path in list_files(folder, (".txt",)):
        require_nonempty_file(path)
        numbers = parse_numbers(iter_text_lines(path), 1, range(6), path)
        if not len(numbers):
            raise InputError("is empty", where=str(path))
        latitude, longitude, height, *angles = numbers[0]
        try:
            scale = scale or math.cos(math.radians(latitude))
            x = scale * _EARTH * math.radians(longitude)
            y = scale * _EARTH * math.log(math.tan(math.pi * (90.0 + latitude) / 360.0))
            position = np.array([x, y, height])
            first = position if first is None else first
            R = scipy.spatial.transform.Rotation.from_euler("ZYX", angles[::-1]).as_matrix()
            out.append(rigid_transform(R, position - first))
        except ValueError as error:
            raise InputError(f"is damaged: {error}", where=str(path)) from error
    return out


MARKER = "times.txt"  # only folders with this file are overwritten

RECORD = 16  # bytes of a point: float32 x y z reflectance
MAX_SCAN = 4 << 30  # bytes of a file

_RAW = Path("velodyne_points/data")

_LAYOUTS = (  # scans and their stamps
    (Path("velodyne"), Path("times.txt")),
    (_RAW, Path("velodyne_points/timestamps.txt")),
)


def is_kitti_folder(path: Path) -> bool:
    """True if a folder has one of the KITTI layouts."""
    return any((path / scans).is_dir() for scans, _ in _LAYOUTS)


def list_scans(path: Path) -> list[Path]:
    """The files of scans in the folder of a recording, by number.

    Raises:
        InputError: the folder cannot be read.
    """
    return list_files(path / _find_layout(path)[0], (".bin",))


def _find_layout(path: Path) -> tuple[Path, Path]:
    return next(one for one in _LAYOUTS if (path / one[0]).is_dir())


def read(path: Path, context: ReadContext) -> Recording:
    """Read an odometry sequence or a raw drive; the laser is the base of the robot.

    Scans of odometry sequences are deskewed, those of raw drives are not: their laser turns
    clockwise and faces ahead at the stamp.

    Raises:
        InputError: there are no stamps, or no scan can be read.
    """
    return _add_times(_read_untimed(path, context), path, context)


def read_parts(
    paths: Sequence[Path],
    context: ReadContext,
    others: Sequence[Path] = (),  # noqa: ARG001
) -> Recording:
    """Read pieces of a drive, in order of time, as one; see `read`."""
    parts = (
        _read_untimed(path, part_context(context, number, len(paths)))
        for number, path in enumerate(paths)
    )
    joined = join_recordings(parts, [str(path) for path in paths], context.scratch)
    window = TimeWindow(context.options)
    recording = select_time(joined, window, str(paths[0])) if window else joined
    return _add_times(recording, paths[0], context)


def _add_times(recording: Recording, path: Path, context: ReadContext) -> Recording:
    """Add times of beams, by the rate of all scans."""
    spin = context.options.spin
    direction = "clockwise" if spin == "auto" and _find_layout(path)[0] == _RAW else spin
    source = {**recording.source, STAMP_AZIMUTH_KEY: _STAMP_AZIMUTH}
    return add_beam_times(replace(recording, source=source), direction)


def _read_untimed(path: Path, context: ReadContext) -> Recording:
    scans, times_file = _find_layout(path)
    files = list_scans(path)
    if not files:
        raise InputError("holds no scan (*.bin)", where=str(path / scans))
    if not (path / times_file).is_file():
        hint = "one line per scan: its stamp in seconds"
        raise InputError("does not exist", where=str(path / times_file), hint=hint)
    times = read_times(path / times_file)
    rows = assign_rows(files, len(times), path / times_file)
    calibration = kitti_cameras.find_calibration(path)
    poses, pose_warnings, by_line = read_poses(path, calibration, len(times), len(files))
    images, image_warnings = find_images(path, calibration, times)
    warnings = [*calibration.warnings, *pose_warnings, *image_warnings]
    info = DatasetInfo(path, "KITTI", warnings)
    sources = []
    for number, (file, row) in enumerate(zip(files, rows, strict=True)):
        stamp_ns = None if row is None else times[row]
        index = row if by_line else number
        T = None if index is None else poses.get(index)
        read_cloud = partial(_read_scan, file, T)
        if stamp_ns is None:
            read_cloud = partial(reject, file, "has no stamp")
        sources.append(CloudSource(file.name, read_cloud, stamp_ns))
    return build_recording(sources, info, context, images=images)


def _read_scan(path: Path, T: NDArray[np.float64] | None) -> Cloud:
    require_nonempty_file(path)
    content = read_bytes(path, MAX_SCAN)
    if len(content) % RECORD:
        raise truncated_error(path, len(content) // RECORD, len(content) // RECORD + 1)
    return Cloud(np.frombuffer(content, "<f4").reshape(-1, 4)[:, :3], T)


def write(recording: Recording, path: str | Path, *, overwrite: bool = False) -> None:
    """Write an odometry sequence with the hits of each scan in the sensor frame, atomically.

    The recorded poses, else the odometry, become `poses.txt`.

    Raises:
        InputError: `path` is taken or cannot be written, or there are several sensors.
    """
    require_single_sensor(recording, str(path))
    T = recording.T_odom_base if recording.T_recorded_base is None else recording.T_recorded_base
    T = sensor_poses(recording, place_clouds(recording, T))
    digits = max(6, len(str(recording.n_scans)))
    with atomic_folder(Path(path), MARKER, overwrite) as folder:
        (folder / "velodyne").mkdir()
        for scan in recording.iter_scans(range(recording.n_scans)):
            points, _ = scan_hits(recording, scan)
            rows = np.zeros((len(points), 4), "<f4")
            rows[:, :3] = points
            (folder / "velodyne" / f"{scan:0{digits}d}.bin").write_bytes(rows.data)
        stamps = (f"{format_seconds(stamp)}\n" for stamp in recording.stamp_ns.tolist())
        (folder / "times.txt").write_text("".join(stamps), encoding="ascii")
        identity = " ".join(f"{value:g}" for value in np.eye(4)[:3].ravel())
        (folder / "calib.txt").write_text(f"Tr: {identity}\n", encoding="ascii")
        if T is not None:
            lines = (" ".join(f"{v:.17g}" for v in pose[:3].ravel()) for pose in T)
            text = "".join(f"{row}\n" for row in lines)
            (folder / "poses.txt").write_text(text, encoding="ascii")
