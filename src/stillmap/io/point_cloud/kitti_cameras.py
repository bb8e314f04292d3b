"""Camera and IMU calibration of KITTI folders, and the images in them."""

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.camera import Camera, Images
from stillmap.core.errors import InputError
from stillmap.core.input_files import InputFile
from stillmap.io import cameras, images
from stillmap.io.rigid_transforms import pose_from_row, rigid_transform
from stillmap.io.scan_files import assign_rows, list_files, read_times

_MAX_BYTES = 1 << 20  # bytes of a calibration file


@dataclass(frozen=True)
class Calibration:
    """Contents of the calibration files.

    Attributes:
        T_camera_laser: (4, 4), of the first rectified camera; None: unknown.
        projection: (3, 4) matrices of the rectified cameras by number.
        T_laser_imu: (4, 4); None: unknown.
        warnings: on files that could not be read.
    """

    T_camera_laser: NDArray[np.float64] | None = None
    projection: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    T_laser_imu: NDArray[np.float64] | None = None
    warnings: tuple[str, ...] = ()


def find_calibration(folder: Path) -> Calibration:
    """Read the calibration of an odometry folder, or of a raw drive or its parent folder."""
    try:
        if (folder / "calib.txt").is_file():
            return _read_odometry_calibration(_read_entries(folder / "calib.txt"))
        for place in (folder, Path(folder.absolute()).parent):
            if (place / "calib_velo_to_cam.txt").is_file():
                return _read_raw_calibration(place)
    except InputError as error:
        return Calibration(warnings=(f"the calibration is ignored: {error}",))
    return Calibration()


def _camera_parameters(
    calibration: Calibration, camera: int
) -> tuple[NDArray[np.float64] | None, NDArray[np.float64] | None]:
    """Intrinsics (3, 3) and pose on the laser (4, 4) of a camera; None: unknown.

    P = K [I | t] projects points of the first rectified camera; t is the offset between both.
    """
    P = calibration.projection.get(camera)
    if P is None:
        return None, None
    K = P[:, :3].copy()
    if calibration.T_camera_laser is None:
        return K, None
    T = np.eye(4)
    try:
        T[:3, 3] = np.linalg.solve(K, P[:, 3])
    except np.linalg.LinAlgError:
        return None, None
    return K, se2.inverse(T @ calibration.T_camera_laser)


def _read_odometry_calibration(entries: dict[str, NDArray[np.float64]]) -> Calibration:
    Tr = next((entries[n] for n in ("Tr", "Tr_velo_cam", "Tr_velo_to_cam") if n in entries), None)
    projection = {n: entries[f"P{n}"] for n in range(4) if f"P{n}" in entries}
    try:
        T = None if Tr is None else pose_from_row(Tr)
        return Calibration(T, {n: _to_projection(P) for n, P in projection.items()})
    except ValueError as error:
        raise InputError(f"calib.txt: {error}") from error


def _read_raw_calibration(folder: Path) -> Calibration:
    try:
        laser = _read_entries(folder / "calib_velo_to_cam.txt")
        T, projection, T_laser_imu = rigid_transform(laser["R"], laser["T"]), {}, None
        if (folder / "calib_cam_to_cam.txt").is_file():
            cameras = _read_entries(folder / "calib_cam_to_cam.txt")
            T = rigid_transform(cameras["R_rect_00"], np.zeros(3)) @ T
            named = {n: cameras.get(f"P_rect_{n:02d}") for n in range(4)}
            projection = {n: _to_projection(P) for n, P in named.items() if P is not None}
        if (folder / "calib_imu_to_velo.txt").is_file():
            imu = _read_entries(folder / "calib_imu_to_velo.txt")
            T_laser_imu = rigid_transform(imu["R"], imu["T"])
        return Calibration(T, projection, T_laser_imu)
    except (ValueError, KeyError) as error:
        raise InputError(f"is damaged: {error}", where=str(folder)) from error


def _to_projection(numbers: NDArray[np.float64]) -> NDArray[np.float64]:
    P = numbers.reshape(3, 4)
    if not np.isfinite(P).all():
        raise ValueError("a projection is not finite")
    return P


def _read_entries(path: Path) -> dict[str, NDArray[np.float64]]:
    """Numbers by the key before the colon; other lines are skipped."""
    with InputFile(path) as file:
        text = file.read(_MAX_BYTES).decode("ascii", "replace")
    out = {}
    for line in text.splitlines():
        name, _, numbers = line.partition(":")
        try:
            out[name.strip()] = np.array([float(word) for word in numbers.split()])
        except ValueError:
            continue
    return out


_FOLDER = re.compile(r"image_0?([0-3])")


def find_images(
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
        match = _FOLDER.fullmatch(place.name)
        if match is None or not place.is_dir():
            continue
        try:
            files = _list_images(place, times)
            camera = _make_camera(place.name, int(match[1]), files, calibration)
        except InputError as error:
            warnings.append(f"the images in {place.name} are ignored: {error}")
            continue
        parts.append(cameras.images_from_files(files, camera))
    return cameras.merge_images(parts) if parts else None, warnings


def _list_images(place: Path, times: list[int | None]) -> list[tuple[int, Path]]:
    """Stamps and files of the images of one camera."""
    inner = place / "data" if (place / "data").is_dir() else place
    files = list_files(inner, images.EXTENSIONS)
    own = place / "timestamps.txt"
    times = read_times(own) if own.is_file() else times
    rows = assign_rows(files, len(times), place) if files else []
    stamps = (None if row is None else times[row] for row in rows)
    return [(stamp, file) for stamp, file in zip(stamps, files, strict=True) if stamp is not None]


def _make_camera(
    name: str, number: int, files: list[tuple[int, Path]], calibration: Calibration
) -> Camera:
    if not files:
        raise InputError("there are none")
    width, height = images.read_image_size(files[0][1])
    K, T = _camera_parameters(calibration, number)
    return Camera(name, width, height, K, "", np.zeros(0), T)
