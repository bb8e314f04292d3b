"""Poses that lie in folders of KITTI, as poses of the laser."""

import math
from pathlib import Path

import numpy as np
import scipy  # its parts load when they are first used
from numpy.typing import NDArray

from stillmap import se2
from stillmap.errors import InputError
from stillmap.recording.clouds.files import files_in, require_content
from stillmap.recording.clouds.kitti_calibration import Calibration
from stillmap.recording.clouds.records import numbers_in, text_lines
from stillmap.recording.clouds.rigid import from_row, transform

_EARTH = 6378137.0  # m
_MOST = 10_000_000  # poses of a file

Poses = list[NDArray[np.float64]]


def recorded(
    folder: Path, calibration: Calibration, lines: int, files: int
) -> tuple[dict[int, NDArray[np.float64]], list[str], bool]:
    """Poses of the laser, by line of the times or by file.

    Args:
        folder: the recording.
        calibration: where the cameras sit.
        lines: how many times there are.
        files: how many sweeps there are.

    Returns:
        T_map_laser (4, 4) by number from 0, warnings, and whether the numbers count lines.
    """
    try:
        poses, name = _found(folder, calibration)
    except InputError as error:
        return {}, [f"poses are not used: {error}"], True
    if len(poses) not in (0, lines, files):
        return {}, [f"poses are not used: {name} has {len(poses)} for {files} sweeps"], True
    return dict(enumerate(poses)), [], len(poses) == lines


def _found(folder: Path, calibration: Calibration) -> tuple[Poses, str]:
    if (folder / "poses_lidar.txt").is_file():
        return _rows(folder / "poses_lidar.txt"), "poses_lidar.txt"
    if (folder / "poses.txt").is_file():
        T = calibration.T_camera_laser
        if T is None:
            raise InputError("they are of the camera, and no calib.txt says where that is")
        return [se2.inverse(T) @ P @ T for P in _rows(folder / "poses.txt")], "poses.txt"
    if (folder / "oxts" / "data").is_dir():
        if calibration.T_laser_imu is None:
            raise InputError("no calib_imu_to_velo.txt says where the inertial unit is")
        T = se2.inverse(calibration.T_laser_imu)
        return [P @ T for P in _inertial(folder / "oxts" / "data")], "oxts"
    return [], ""


def _rows(path: Path) -> Poses:
    numbers = numbers_in(text_lines(path), _MOST, range(12), path)
    out = []
    for i, row in enumerate(numbers):
        try:
            out.append(from_row(row))
        except ValueError as error:
            raise InputError(str(error), where=f"{path}:{i + 1}") from error
    return out


def _inertial(folder: Path) -> Poses:
    """T_map_imu of files of latitude, longitude (degrees), height (m), roll, pitch, yaw (rad).

    East, north and up from the first, on the Mercator map that is true to scale there.
    """
    out: Poses = []
    scale = first = None
    for path in files_in(folder, (".txt",)):
        require_content(path)
        numbers = numbers_in(text_lines(path), 1, range(6), path)
        if not len(numbers):
            raise InputError("is empty", where=str(path))
        latitude, longitude, height, *angles = numbers[0]
        try:
            scale = scale or math.cos(math.radians(latitude))
            x = scale * _EARTH * math.radians(longitude)
            y = scale * _EARTH * math.log(math.tan(math.pi * (90.0 + latitude) / 360.0))
            place = np.array([x, y, height])
            first = place if first is None else first
            R = scipy.spatial.transform.Rotation.from_euler("ZYX", angles[::-1]).as_matrix()
            out.append(transform(R, place - first))
        except ValueError as error:
            raise InputError(f"is damaged: {error}", where=str(path)) from error
    return out
