"""Pictures in folders of KITTI."""

import re
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.errors import InputError
from stillmap.recording import pictures
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
    cameras: list[Camera] = []
    stamp_ns: list[int] = []
    camera_of: list[int] = []
    files: list[Path] = []
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
        files += [file for _, file in found]
        stamp_ns += [stamp for stamp, _ in found]
        camera_of += [len(cameras)] * len(found)
        cameras.append(camera)
    if not files:
        return None, warnings
    order = np.argsort(np.array(stamp_ns, np.int64), kind="stable")
    sorted_files = [files[i] for i in order]
    images = Images(
        stamp_ns=np.array(stamp_ns, np.int64)[order],
        camera=np.array(camera_of, np.int32)[order],
        cameras=tuple(cameras),
        load=partial(_load, sorted_files),
    )
    return images, warnings


def _load(files: list[Path], image: int) -> NDArray[Any]:
    return pictures.read_picture(files[image])


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
