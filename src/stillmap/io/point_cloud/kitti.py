"""KITTI folders: odometry sequences (`velodyne/`, `times.txt`), raw drives, and their poses."""

import math
import re
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Float
from stillmap.core.camera import Camera, Images
from stillmap.core.errors import InputError, explaining_damage
from stillmap.core.files import atomic_folder
from stillmap.core.input_files import read_bytes
from stillmap.core.recording import Recording
from stillmap.core.source import Source
from stillmap.core.timestamps import format_seconds
from stillmap.io import cameras
from stillmap.io.builder import ReadContext
from stillmap.io.point_cloud import clouds, table
from stillmap.io.text_lines import assign_rows, list_files, read_times, stamp_files
from stillmap.io.trajectory import pose_from_row, rigid_transform

MARKER = "times.txt"  # only folders with this file are overwritten

_EARTH = 6378137.0  # m
_POINT = np.dtype([(name, "<f4") for name in ("x", "y", "z", "reflectance")])
_CAMERA_FOLDER = re.compile(r"image_0?([0-3])")
_RAW = Path("velodyne_points/data")
_LAYOUTS = (  # scans and their stamps
    (Path("velodyne"), Path("times.txt")),
    (_RAW, Path("velodyne_points/timestamps.txt")),
)


class Calibration(NamedTuple):
    """Contents of the calibration files.

    Attributes:
        T_camera_laser: (4, 4), of the first rectified camera; None: unknown.
        projection: (3, 4) matrices of the rectified cameras by number.
        T_laser_imu: (4, 4); None: unknown.
        warnings: on files that could not be read.
    """

    T_camera_laser: Float | None = None
    projection: dict[int, Float] = {}  # noqa: RUF012
    T_laser_imu: Float | None = None
    warnings: tuple[str, ...] = ()


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
    return next(layout for layout in _LAYOUTS if (path / layout[0]).is_dir())


def read(path: Path, context: ReadContext) -> Recording:
    """Read an odometry sequence or a raw drive; the laser is the base of the robot.

    Scans of odometry sequences are deskewed, those of raw drives are not: their laser turns
    clockwise and faces ahead at the stamp.

    Raises:
        InputError: there are no stamps, or no scan can be read.
    """
    scans, times_file = _find_layout(path)
    files = list_scans(path)
    if not files:
        raise InputError("holds no scan (*.bin)", where=str(path / scans))
    if not (path / times_file).is_file():
        hint = "one line per scan: its stamp in seconds"
        raise InputError("does not exist", where=str(path / times_file), hint=hint)
    times = read_times(path / times_file)
    rows = assign_rows(files, len(times), path / times_file)
    calibration = find_calibration(path)
    poses, pose_warnings, by_line = _read_poses(path, calibration, len(times), len(files))
    pictures, image_warnings = _find_images(path, calibration, times)
    warnings = [*calibration.warnings, *pose_warnings, *image_warnings]
    sources = []
    for number, (file, row) in enumerate(zip(files, rows, strict=True)):
        stamp_ns = None if row is None else times[row]
        index = row if by_line else number
        read_cloud = partial(_read_scan, file, None if index is None else poses.get(index))
        if stamp_ns is None:
            read_cloud = partial(clouds.reject, file, "has no stamp")
        sources.append(clouds.CloudSource(file.name, read_cloud, stamp_ns))
    notes = Source(str(path), format="KITTI", warnings=warnings, stamp_azimuth=0.0)
    if scans == _RAW:
        notes.spin_direction = "clockwise"
    return clouds.build_recording(sources, notes, context, images=pictures)


def scan_layout(path: Path) -> table.TableLayout:
    """The layout of the points of a scan.

    Raises:
        InputError: it is empty, or ends within a point.
    """
    with table.open_table(path) as file:
        if file.size % _POINT.itemsize:
            raise table.truncated_error(path)
        return table.TableLayout(path, _POINT, file.size // _POINT.itemsize)


def _read_scan(path: Path, T: Float | None) -> clouds.Cloud:
    points, _ = table.gather_points(table.read_columns(scan_layout(path), "xyz"), np.asarray)
    return clouds.Cloud(points, T)


def _read_poses(
    folder: Path, calibration: Calibration, lines: int, files: int
) -> tuple[dict[int, Float], list[str], bool]:
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


def _read_pose_file(folder: Path, calibration: Calibration) -> tuple[list[Float], str]:
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


def _read_rows(path: Path) -> list[Float]:
    numbers = table.parse_numbers(table.iter_text_lines(path), 10_000_000, range(12), path)
    try:
        return [pose_from_row(row) for row in numbers]
    except ValueError as error:
        raise InputError(str(error), where=str(path)) from error


def _read_oxts(folder: Path) -> list[Float]:
    """T_map_imu of files of latitude, longitude (degrees), height (m), roll, pitch, yaw (rad).

    East, north and up from the first pose, in the Mercator projection that is to scale there.
    """
    from scipy.spatial.transform import Rotation

    out: list[Float] = []
    scale = first = None
    for path in list_files(folder, (".txt",)):
        numbers = table.parse_numbers(table.iter_text_lines(path), 1, range(6), path)
        if not len(numbers):
            raise InputError("is empty", where=str(path))
        latitude, longitude, height, *angles = numbers[0]
        with explaining_damage(path):
            scale = scale or math.cos(math.radians(latitude))
            x = scale * _EARTH * math.radians(longitude)
            y = scale * _EARTH * math.log(math.tan(math.pi * (90.0 + latitude) / 360.0))
            position = np.array([x, y, height])
            first = position if first is None else first
            R = Rotation.from_euler("ZYX", angles[::-1]).as_matrix()
            out.append(rigid_transform(R, position - first))
    return out


def find_calibration(folder: Path) -> Calibration:
    """Read the calibration of an odometry folder, or of a raw drive or its parent folder."""
    try:
        if (folder / "calib.txt").is_file():
            return _read_odometry_calibration(_read_entries(folder / "calib.txt"))
        for place in (folder, Path(folder.absolute()).parent):
            if (place / "calib_velo_to_cam.txt").is_file():
                return _read_raw_calibration(place)
    except (InputError, ValueError, KeyError) as error:
        return Calibration(warnings=(f"the calibration is ignored: it is damaged: {error}",))
    return Calibration()


def _read_odometry_calibration(entries: dict[str, Float]) -> Calibration:
    rows = [entries[name] for name in ("Tr", "Tr_velo_cam", "Tr_velo_to_cam") if name in entries]
    projection = {n: _to_projection(entries[f"P{n}"]) for n in range(4) if f"P{n}" in entries}
    return Calibration(pose_from_row(rows[0]) if rows else None, projection)


def _read_raw_calibration(folder: Path) -> Calibration:
    laser = _read_entries(folder / "calib_velo_to_cam.txt")
    T, projection, T_laser_imu = rigid_transform(laser["R"], laser["T"]), {}, None
    if (folder / "calib_cam_to_cam.txt").is_file():
        rectified = _read_entries(folder / "calib_cam_to_cam.txt")
        T = rigid_transform(rectified["R_rect_00"], np.zeros(3)) @ T
        named = {n: rectified.get(f"P_rect_{n:02d}") for n in range(4)}
        projection = {n: _to_projection(P) for n, P in named.items() if P is not None}
    if (folder / "calib_imu_to_velo.txt").is_file():
        imu = _read_entries(folder / "calib_imu_to_velo.txt")
        T_laser_imu = rigid_transform(imu["R"], imu["T"])
    return Calibration(T, projection, T_laser_imu)


def _to_projection(numbers: Float) -> Float:
    P = numbers.reshape(3, 4)
    if not np.isfinite(P).all():
        raise ValueError("a projection is not finite")
    return P


def _read_entries(path: Path) -> dict[str, Float]:
    """Numbers by the key before the colon; other lines are skipped."""
    text = read_bytes(path, 1 << 20).decode("ascii", "replace")
    out = {}
    for line in text.splitlines():
        name, _, numbers = line.partition(":")
        with suppress(ValueError):
            out[name.strip()] = np.array([float(word) for word in numbers.split()])
    return out


def _find_images(
    folder: Path, calibration: Calibration, times: list[int | None]
) -> tuple[Images | None, list[str]]:
    """The images of all cameras, and warnings on those that are ignored.

    Args:
        folder: the recording.
        calibration: intrinsics and extrinsics.
        times: stamps of the scans, for images without stamps of their own.
    """
    parts: list[Images] = []
    warnings: list[str] = []
    for place in sorted(folder.iterdir()):
        match = _CAMERA_FOLDER.fullmatch(place.name)
        if match is None or not place.is_dir():
            continue
        inner = place / "data" if (place / "data").is_dir() else place
        own = place / "timestamps.txt"
        try:
            listed = list_files(inner, cameras.EXTENSIONS)
            files = stamp_files(listed, read_times(own) if own.is_file() else times, place)
            camera = _make_camera(place.name, int(match[1]), files, calibration)
        except InputError as error:
            warnings.append(f"the images in {place.name} are ignored: {error}")
            continue
        parts.append(cameras.images_from_files(files, camera))
    return cameras.merge_images(parts) if parts else None, warnings


def _make_camera(
    name: str, number: int, files: list[tuple[int, Path]], calibration: Calibration
) -> Camera:
    """The camera of some images.

    P = K [I | t] projects points of the first rectified camera; t is the offset between both.
    """
    if not files:
        raise InputError("there are none")
    width, height = cameras.read_image_size(files[0][1])
    P, T_camera_laser = calibration.projection.get(number), calibration.T_camera_laser
    K, T_laser_camera = None if P is None else P[:, :3].copy(), None
    if P is not None and T_camera_laser is not None:
        T = np.eye(4)
        try:
            T[:3, 3] = np.linalg.solve(P[:, :3], P[:, 3])
            T_laser_camera = se2.inverse(T @ T_camera_laser)
        except np.linalg.LinAlgError:
            K = None
    return Camera(name, width, height, K, "", np.zeros(0), T_laser_camera)


def write(recording: Recording, path: Path, overwrite: bool = False) -> list[str]:
    """Write an odometry sequence with the hits of each scan in the sensor frame, atomically.

    The recorded poses, else the odometry, become `poses.txt`. Returns what is left out, a sentence
    each.

    Raises:
        InputError: `path` is taken or cannot be written.
    """
    T = recording.T_odom_base if recording.T_recorded_base is None else recording.T_recorded_base
    T = clouds.sensor_poses(recording, T)
    digits = max(6, len(str(recording.n_scans)))
    with atomic_folder(path, MARKER, overwrite) as folder:
        (folder / "velodyne").mkdir()
        for scan in recording.iter_scans(range(recording.n_scans)):
            points, _ = clouds.scan_hits(recording, scan)
            rows = np.zeros((len(points), 4), "<f4")
            rows[:, :3] = points
            (folder / "velodyne" / f"{scan:0{digits}d}.bin").write_bytes(rows.data)
        stamps = (f"{format_seconds(stamp)}\n" for stamp in recording.stamp_ns.tolist())
        (folder / "times.txt").write_text("".join(stamps), encoding="ascii")
        (folder / "calib.txt").write_text("Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n", encoding="ascii")
        if T is not None:
            lines = (" ".join(f"{v:.17g}" for v in pose[:3].ravel()) for pose in T)
            text = "".join(f"{row}\n" for row in lines)
            (folder / "poses.txt").write_text(text, encoding="ascii")
    losses = clouds.describe_non_returns(recording)
    if recording.T_odom_base is None:
        return losses
    if recording.T_recorded_base is None:
        return ["its odometry is written as poses", *losses]
    return ["its odometry readings are left out", *losses]
