"""Pictures in folders of KITTI."""

import re
from pathlib import Path

import numpy as np

from stillmap.errors import InputError
from stillmap.recording import cameras, pictures
from stillmap.recording.clouds.files import files_in
from stillmap.recording.clouds.kitti_calibration import Calibration, lens
from stillmap.recording.clouds.kitti_times import read_times, rows_of
from stillmap.recording.images import Camera, Images

_FOLDER = re.compile(r"image_0?([0-3])")


def find(
    folder: Path, calibration: Calibration, times: list[int | None]
) -> tuple[Images | None, list[str]]:
    """The pictures of all cameras, and warnings on those that cannot be used.

    Args:
        folder: the recording.
        calibration: where the cameras sit.
        times: of the sweeps, which are those of pictures without their own.
    """
    parts: list[Images] = []
    warnings: list[str] = []
    for place in sorted(folder.iterdir()):
        match = _FOLDER.fullmatch(place.name)
        if match is None or not place.is_dir():
            continue
        try:
            found = _of_camera(place, times)
            camera = _camera(place.name, int(match[1]), found, calibration)
        except InputError as error:
            warnings.append(f"the pictures in {place.name} are not used: {error}")
            continue
        parts.append(cameras.from_files(found, camera))
    return cameras.joined(parts) if parts else None, warnings


def _of_camera(place: Path, times: list[int | None]) -> list[tuple[int, Path]]:
    """Stamps and files of one camera's pictures."""
    inner = place / "data" if (place / "data").is_dir() else place
    files = files_in(inner, pictures.ENDINGS)
    own = place / "timestamps.txt"
    times = read_times(own) if own.is_file() else times
    rows = rows_of(files, len(times), place) if files else []
    stamps = (None if row is None else times[row] for row in rows)
    return [(stamp, file) for stamp, file in zip(stamps, files, strict=True) if stamp is not None]


def _camera(
    name: str, number: int, found: list[tuple[int, Path]], calibration: Calibration
) -> Camera:
    if not found:
        raise InputError("there are none")
    width, height = pictures.size_of(found[0][1])
    K, T = lens(calibration, number)
    return Camera(name, width, height, K, "", np.zeros(0), T)
