"""Images and camera calibrations of a recording, overridden or added by `--cameras FILE`."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from stillmap.core.camera import Camera, Images
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.io import camera_file
from stillmap.io.camera_file import CameraOverride
from stillmap.io.images import EXTENSIONS, read_image, read_image_size
from stillmap.io.scan_files import (
    assign_rows,
    list_files,
    read_times,
    stamps_from_names,
    strip_extension,
)

_NO_IMAGES = Images(np.zeros(0, np.int64), np.zeros(0, np.int32), (), lambda _: np.zeros((0, 0)))


def apply_camera_file(recording: Recording, path: Path) -> Recording:
    """Apply the calibrations of a camera file, and add the image folders that it names.

    Raises:
        InputError: the file is invalid, or names a camera or images that do not exist.
    """
    images = recording.images or _NO_IMAGES
    recorded = [camera.name for camera in images.cameras]
    overrides = camera_file.read_camera_file(
        path, [*recorded, *depth_camera_names(recording.source)]
    )
    for name, one in overrides.items():
        if one.folder is not None and name in recorded:
            what = f"camera '{name}' has images in the recording: 'folder' is for others"
            raise InputError(what, where=str(path))
    parts = [_apply_overrides(images, overrides)]
    for name, one in overrides.items():
        if one.folder is not None:
            try:
                parts.append(_read_folder(name, one, one.folder, str(path)))
            except InputError as error:
                hint = error.hint or f"camera '{name}' of {path}"
                raise InputError(error.what, where=error.where, hint=hint) from error
    merged = merge_images(parts)
    return replace(recording, images=merged if merged.cameras else None)


def add_calibration_warnings(recording: Recording) -> Recording:
    """Add a warning for each camera whose calibration is implausible, unless it is there."""
    cameras = recording.images.cameras if recording.images is not None else ()
    recorded = recording.source.get("warnings")
    warnings = recorded if isinstance(recorded, list) else []
    new = [what for camera in cameras if (what := validate_camera(camera)) and what not in warnings]
    if not new:
        return recording
    return replace(recording, source={**recording.source, "warnings": [*warnings, *new]})


def validate_camera(camera: Camera) -> str:
    """A warning where the principal point lies outside the image; else ""."""
    if camera.K is None or not np.isfinite(camera.K).all():
        return ""
    at, size = camera.K[:2, 2], np.array([camera.width, camera.height])
    if not size.all() or ((at >= 0.0) & (at <= size)).all():
        return ""
    return (
        f"camera '{camera.name}': its principal point, {at[0]:g}, {at[1]:g}, lies outside "
        f"images of {size[0]} x {size[1]} pixels: valid only where they are crops of larger ones"
    )


def depth_camera_names(source: dict[str, Any]) -> list[str]:
    """Names of the sensors that are depth cameras: their scans are grids."""
    recorded = source.get("sensors")
    sensors = recorded if isinstance(recorded, list) else []
    return [str(one.get("name")) for one in sensors if isinstance(one, dict) and one.get("grid")]


def images_from_files(files: Sequence[tuple[int, Path]], camera: Camera) -> Images:
    """The images of one camera, from stamps (ns) and files in any order."""
    ordered = sorted(files, key=lambda one: one[0])
    return Images(
        stamp_ns=np.array([stamp for stamp, _ in ordered], np.int64),
        camera=np.zeros(len(ordered), np.int32),
        cameras=(camera,),
        load=lambda image: read_image(ordered[image][1]),
    )


def merge_images(parts: Sequence[Images]) -> Images:
    """All images, ordered by stamp; cameras of the same name are one."""
    if len(parts) == 1:
        return parts[0]
    cameras: dict[str, Camera] = {}
    for one in (camera for part in parts for camera in part.cameras):
        cameras.setdefault(one.name, one)
    numbers = {name: number for number, name in enumerate(cameras)}
    stamp_ns = np.concatenate([part.stamp_ns for part in parts])
    camera = np.concatenate(
        [np.array([numbers[one.name] for one in part.cameras])[part.camera] for part in parts]
    )
    part_of = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    number = np.concatenate([np.arange(len(part)) for part in parts])
    order = np.argsort(stamp_ns, kind="stable")
    part_of, number = part_of[order].tolist(), number[order].tolist()
    return Images(
        stamp_ns[order],
        camera[order].astype(np.int32),
        tuple(cameras.values()),
        lambda image: parts[part_of[image]].read(number[image]),
    )


def _apply_overrides(images: Images, overrides: dict[str, CameraOverride]) -> Images:
    """Images of the recording with overridden cameras, sorted again by their shifted stamps."""
    cameras, stamp_ns = list(images.cameras), images.stamp_ns.copy()
    for number, camera in enumerate(cameras):
        one = overrides.get(camera.name)
        if one is not None:
            cameras[number] = one.apply_to(camera)
            stamp_ns[images.camera == number] += one.time_offset_ns
    order = np.argsort(stamp_ns, kind="stable")
    return Images(
        stamp_ns[order],
        images.camera[order],
        tuple(cameras),
        lambda image: images.read(int(order[image])),
    )


def _read_folder(name: str, override: CameraOverride, folder: Path, where: str) -> Images:
    """Images of a folder outside the recording."""
    files = list_files(folder, EXTENSIONS)
    if not files:
        raise InputError("holds no images", where=str(folder))
    if override.times is not None:
        times = read_times(override.times)
        rows = assign_rows(files, len(times), override.times)
        stamps = [None if row is None else times[row] for row in rows]
    else:
        found = stamps_from_names([strip_extension(file.name, EXTENSIONS) for file in files])
        if found is None:
            hint = f"times = 'FILE' in camera '{name}' of {where}: one line of seconds per image"
            raise InputError("holds images whose names are no stamps", where=str(folder), hint=hint)
        stamps = list(found)
    used = [(s, f) for s, f in zip(stamps, files, strict=True) if s is not None]
    if not used:
        raise InputError("holds no usable stamp", where=str(override.times))
    width, height = read_image_size(used[0][1])
    camera = override.apply_to(Camera(name, width, height, None, "", np.zeros(0), None))
    return images_from_files(
        [(stamp + override.time_offset_ns, file) for stamp, file in used], camera
    )
