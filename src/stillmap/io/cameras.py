"""Cameras and pictures as a file of the user's has them, laid over a recording's own."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.camera import Camera, Images
from stillmap.core.errors import InputError
from stillmap.core.files import require_regular
from stillmap.core.recording import Recording
from stillmap.io import camera_file
from stillmap.io.camera_file import CameraOverride
from stillmap.io.images import EXTENSIONS, read_image, read_image_size
from stillmap.io.point_cloud.files import list_files, stamps_from_names, strip_extension
from stillmap.io.point_cloud.kitti_times import assign_rows, read_times

_NO_IMAGES = Images(np.zeros(0, np.int64), np.zeros(0, np.int32), (), lambda _: np.zeros((0, 0)))


def apply_camera_file(recording: Recording, path: Path) -> Recording:
    """The recording, with cameras as a file says, and the pictures that it names.

    Raises:
        InputError: the file is wrong, names a camera that is not there, or pictures that are not.
    """
    images = recording.images or _NO_IMAGES
    known = [camera.name for camera in images.cameras]
    given = camera_file.read_camera_file(path, [*known, *depth_camera_names(recording.source)])
    for name, one in given.items():
        if one.folder is not None and name in known:
            what = f"camera '{name}' has pictures in the recording: 'folder' is for others"
            raise InputError(what, where=str(path))
    parts = [_changed(images, given)]
    for name, one in given.items():
        if one.folder is not None:
            try:
                parts.append(_added(name, one, one.folder, str(path)))
            except InputError as error:
                hint = error.hint or f"camera '{name}' of {path}"
                raise InputError(error.what, where=error.where, hint=hint) from error
    together = merge_images(parts)
    return replace(recording, images=together if together.cameras else None)


def add_calibration_warnings(recording: Recording) -> Recording:
    """The recording, with a warning for each camera whose calibration is hardly that of its
    pictures; one that it has already is not repeated."""
    of = recording.images.cameras if recording.images is not None else ()
    noted = recording.source.get("warnings")
    warnings = noted if isinstance(noted, list) else []
    new = [what for camera in of if (what := validate_camera(camera)) and what not in warnings]
    if not new:
        return recording
    return replace(recording, source={**recording.source, "warnings": [*warnings, *new]})


def validate_camera(camera: Camera) -> str:
    """Why a camera's calibration is hardly that of its pictures; "" where it may well be."""
    if camera.K is None or not np.isfinite(camera.K).all():
        return ""
    at, size = camera.K[:2, 2], np.array([camera.width, camera.height])
    if not size.all() or ((at >= 0.0) & (at <= size)).all():
        return ""
    return (
        f"camera '{camera.name}': its principal point, {at[0]:g}, {at[1]:g}, lies outside of "
        f"pictures of {size[0]} x {size[1]} pixels: right only where they are parts of larger ones"
    )


def depth_camera_names(source: dict[str, Any]) -> list[str]:
    """Names of the sensors of a recording that are cameras themselves: their scans are grids."""
    notes = source.get("sensors")
    sensors = notes if isinstance(notes, list) else []
    return [str(one.get("name")) for one in sensors if isinstance(one, dict) and one.get("grid")]


def images_from_files(found: Sequence[tuple[int, Path]], camera: Camera) -> Images:
    """The pictures of one camera, in files of which the stamps are known, in any order."""
    ordered = sorted(found, key=lambda one: one[0])
    return Images(
        stamp_ns=np.array([stamp for stamp, _ in ordered], np.int64),
        camera=np.zeros(len(ordered), np.int32),
        cameras=(camera,),
        load=partial(_load, [file for _, file in ordered]),
    )


def merge_images(parts: Sequence[Images]) -> Images:
    """All pictures of several cameras, or sets of cameras, in the order of their stamps."""
    if len(parts) == 1:
        return parts[0]
    first = np.cumsum([0, *(len(part.cameras) for part in parts)])
    stamp_ns = np.concatenate([part.stamp_ns for part in parts])
    camera = np.concatenate([part.camera + n for part, n in zip(parts, first[:-1], strict=True)])
    of = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    number = np.concatenate([np.arange(len(part)) for part in parts])
    order = np.argsort(stamp_ns, kind="stable")
    of, number = of[order], number[order]

    def load(image: int) -> NDArray[Any]:
        picture: NDArray[Any] = parts[of[image]].read(int(number[image]))
        return picture

    cameras = tuple(one for part in parts for one in part.cameras)
    return Images(stamp_ns[order], camera[order].astype(np.int32), cameras, load)


def _changed(images: Images, given: dict[str, CameraOverride]) -> Images:
    """The recording's own pictures; with a time added, they may come in another order."""
    cameras, stamp_ns = list(images.cameras), images.stamp_ns.copy()
    for number, camera in enumerate(cameras):
        one = given.get(camera.name)
        if one is not None:
            cameras[number] = one.apply_to(camera)
            stamp_ns[images.camera == number] += one.time_offset_ns
    order = np.argsort(stamp_ns, kind="stable")

    def load(image: int) -> NDArray[Any]:
        return images.read(int(order[image]))

    return Images(stamp_ns[order], images.camera[order], tuple(cameras), load)


def _added(name: str, given: CameraOverride, folder: Path, where: str) -> Images:
    """The pictures of a folder that the recording does not know of."""
    files = list_files(folder, EXTENSIONS)
    if not files:
        raise InputError("holds no pictures", where=str(folder))
    if given.times is not None:
        require_regular(given.times)
        times = read_times(given.times)
        rows = assign_rows(files, len(times), given.times)
        stamps = [None if row is None else times[row] for row in rows]
    else:
        found = stamps_from_names([strip_extension(file.name, EXTENSIONS) for file in files])
        if found is None:
            hint = f"times = 'FILE' in camera '{name}' of {where}: a line of seconds for each"
            raise InputError(
                "holds pictures whose names are no times", where=str(folder), hint=hint
            )
        stamps = list(found)
    used = [(s, f) for s, f in zip(stamps, files, strict=True) if s is not None]
    if not used:
        raise InputError("holds no usable time", where=str(given.times))
    width, height = read_image_size(used[0][1])
    camera = given.apply_to(Camera(name, width, height, None, "", np.zeros(0), None))
    return images_from_files([(stamp + given.time_offset_ns, file) for stamp, file in used], camera)


def _load(files: list[Path], image: int) -> NDArray[Any]:
    return read_image(files[image])
