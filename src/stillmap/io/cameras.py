"""Images and camera calibrations of a recording, overridden or added by `--cameras FILE`.

The file is TOML, one table per camera:

["/front/image_raw"]             # topic or folder, named as in `stillmap info`
fx = 525.0
fy = 525.0
cx = 319.5
cy = 239.5
model = "plumb_bob"
distortion = [0.26, -0.95, -0.005, 0.003, 1.16]
translation = [0.2, 0.0, 0.5]    # of T_base_camera; camera axes: x right, y down, z ahead
quaternion = [-0.5, 0.5, -0.5, 0.5]
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.camera import Camera, Images
from stillmap.core.config import load_toml
from stillmap.core.errors import InputError, closest_match
from stillmap.core.recording import Recording
from stillmap.io.images import EXTENSIONS, read_image, read_image_size
from stillmap.io.rigid_transforms import rigid_transform
from stillmap.io.scan_files import (
    assign_rows,
    list_files,
    read_times,
    stamps_from_names,
    strip_extension,
)

Float = NDArray[np.float64]

MODELS = {"": (0,), "plumb_bob": (4, 5), "rational_polynomial": (8,), "equidistant": (4,)}

_FOCAL = ("fx", "fy", "cx", "cy")
_SIZE = ("width", "height")
_POSE = ("T_base_camera", "translation", "quaternion", "rpy")
_KEYS = (
    *("K", *_FOCAL, *_SIZE, "model", "distortion", *_POSE),
    *("time_offset", "folder", "times"),
)
_MAX_NUMBER = 1e6  # pixels, metres, seconds
_MAX_SIZE = 1 << 16  # pixels


@dataclass(frozen=True, eq=False)
class CameraOverride:
    """Values of one camera; None: not given.

    Attributes:
        K: (3, 3) pinhole matrix.
        width, height: pixels.
        model, distortion: see Camera; both or neither.
        T_base_camera: (4, 4).
        time_offset_ns: added to the stamps of its images.
        folder: of images outside the recording.
        times: file with their stamps; None: from their names.
    """

    K: Float | None = None
    width: int | None = None
    height: int | None = None
    model: str | None = None
    distortion: Float | None = None
    T_base_camera: Float | None = None
    time_offset_ns: int = 0
    folder: Path | None = None
    times: Path | None = None

    def apply_to(self, camera: Camera) -> Camera:
        """The camera with the given values in place of its own."""
        names = ("K", *_SIZE, "model", "distortion", "T_base_camera")
        return replace(camera, **{n: v for n in names if (v := getattr(self, n)) is not None})


def read_camera_file(path: Path, known: Sequence[str] | None = None) -> dict[str, CameraOverride]:
    """Read the cameras of a file, by name.

    Args:
        path: the file.
        known: names of cameras that need no image folder; None: all.

    Raises:
        InputError: it cannot be read, or a name, key or value is invalid.
    """
    out, tables = {}, load_toml(path)
    for name, table in tables.items():
        if not isinstance(table, Mapping):
            hint = "a camera is a table: [NAME], with its values below"
            raise InputError(f"'{name}' stands outside of a camera", where=str(path), hint=hint)
        if known is not None and name not in known and "folder" not in table:
            what = f"there is no camera '{name}'"
            raise InputError(what, where=str(path), hint=_hint(name, known))
    for name, table in tables.items():
        try:
            out[name] = _parse_camera(table, path.parent)
        except ValueError as error:
            raise InputError(f"camera '{name}': {error}", where=str(path)) from error
    if not out:
        raise InputError("names no camera", where=str(path), hint="a table for each: [NAME]")
    return out


def _hint(name: str, known: Sequence[str]) -> str:
    if not known:
        return "the recording has no images; folder = '...' adds some"
    return f"nearest: '{closest_match(name, known, min_similarity=0.0)}'; folder = '...' adds one"


def _parse_camera(table: Mapping[str, Any], folder: Path) -> CameraOverride:
    for key in table:
        if key not in _KEYS:
            raise ValueError(
                f"unknown key '{key}' (nearest: '{closest_match(key, _KEYS, min_similarity=0.0)}')"
            )
    model, distortion = _parse_distortion(table)
    width, height = (_parse_size(table, key) for key in _SIZE)
    if (width is None) != (height is None):
        raise ValueError("'width' and 'height' go together")
    if "times" in table and "folder" not in table:
        raise ValueError("'times' is for a 'folder' of images")
    offset = _parse_numbers(table, "time_offset", ())
    return CameraOverride(
        K=_parse_K(table),
        width=width,
        height=height,
        model=model,
        distortion=distortion,
        T_base_camera=_parse_pose(table),
        time_offset_ns=0 if offset is None else round(float(offset) * 1e9),
        folder=_parse_path(table, "folder", folder),
        times=_parse_path(table, "times", folder),
    )


def _parse_K(table: Mapping[str, Any]) -> Float | None:
    K = _parse_numbers(table, "K", (3, 3))
    given = [key for key in _FOCAL if key in table]
    if K is None and given:
        missing = [key for key in _FOCAL if key not in table]
        if missing:
            raise ValueError(f"'{given[0]}' wants '{missing[0]}' beside it")
        fx, fy, cx, cy = (float(_parse_numbers(table, key, ())) for key in _FOCAL)  # type: ignore[arg-type]
        K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    elif given:
        raise ValueError(f"'K' and '{given[0]}' exclude each other")
    if K is None:
        return None
    if not (K[0, 0] > 0.0 and K[1, 1] > 0.0 and K[1, 0] == 0.0):
        raise ValueError("focal lengths must be positive")
    if not np.array_equal(K[2], [0.0, 0.0, 1.0]):
        raise ValueError("the last row of 'K' must be 0, 0, 1")
    return K


def _parse_distortion(table: Mapping[str, Any]) -> tuple[str | None, Float | None]:
    model = table.get("model")
    distortion = _parse_numbers(table, "distortion", (-1,))
    if model is None:
        if distortion is not None:
            raise ValueError(f"'distortion' wants 'model': one of {_models()}")
        return None, None
    if not isinstance(model, str) or model not in MODELS:
        raise ValueError(f"'model' must be one of {_models()}, got {model!r}")
    distortion = np.zeros(0) if distortion is None else distortion
    if len(distortion) not in MODELS[model]:
        wanted = " or ".join(str(n) for n in MODELS[model])
        what = f"'distortion' of model '{model}' wants {wanted} numbers"
        raise ValueError(f"{what}, got {len(distortion)}")
    return model, distortion


def _models() -> str:
    return ", ".join(f"'{name}'" for name in MODELS)


def _parse_pose(table: Mapping[str, Any]) -> Float | None:
    given = [key for key in _POSE if key in table]
    if not given:
        return None
    T = _parse_numbers(table, "T_base_camera", (4, 4))
    if T is not None:
        if len(given) > 1:
            raise ValueError(f"'T_base_camera' and '{given[1]}' exclude each other")
        if not np.array_equal(T[3], [0.0, 0.0, 0.0, 1.0]):
            raise ValueError("the last row of 'T_base_camera' must be 0, 0, 0, 1")
        return rigid_transform(T[:3, :3], T[:3, 3])
    t = _parse_numbers(table, "translation", (3,))
    q, rpy = _parse_numbers(table, "quaternion", (4,)), _parse_numbers(table, "rpy", (3,))
    if t is None or (q is None) == (rpy is None):
        raise ValueError("a pose wants 'translation', and one of 'quaternion' and 'rpy'")
    from scipy.spatial.transform import Rotation  # slow to load

    if rpy is not None:
        return rigid_transform(Rotation.from_euler("xyz", rpy).as_matrix(), t)
    assert q is not None
    if not abs(np.linalg.norm(q) - 1.0) < 0.02:
        raise ValueError("'quaternion' (x, y, z, w) is not of length one")
    return rigid_transform(Rotation.from_quat(q).as_matrix(), t)


def _parse_size(table: Mapping[str, Any], key: str) -> int | None:
    value = table.get(key)
    if value is not None and not (type(value) is int and 0 < value <= _MAX_SIZE):
        raise ValueError(f"'{key}' wants a count of pixels")
    return value


def _parse_path(table: Mapping[str, Any], key: str, folder: Path) -> Path | None:
    value = table.get(key)
    if value is None:
        return None
    if not isinstance(value, str) or not value or "\0" in value:
        raise ValueError(f"'{key}' wants a path")
    return folder / value


def _parse_numbers(table: Mapping[str, Any], key: str, shape: tuple[int, ...]) -> Float | None:
    """The numbers of a key in a shape, (-1,) for any count; None where the key is missing.

    Raises:
        ValueError: it holds something else, or another count of numbers.
    """
    if key not in table:
        return None
    flat = list(_flatten(table[key], key))
    count = math.prod(shape)
    if (count >= 0 and len(flat) != count) or (shape == ()) == isinstance(table[key], list):
        wanted = "a number" if shape == () else f"{' x '.join(map(str, shape))} numbers"
        raise ValueError(f"'{key}' wants {wanted}")
    return np.array(flat).reshape(shape)


def _flatten(value: Any, key: str) -> Iterator[float]:
    for one in value if isinstance(value, list) else [value]:
        if isinstance(one, list):
            yield from _flatten(one, key)
        elif isinstance(one, bool) or not isinstance(one, int | float):
            raise ValueError(f"'{key}' wants numbers")
        elif not abs(one) <= _MAX_NUMBER:
            raise ValueError(f"'{key}' wants smaller numbers")
        else:
            yield float(one)


_NO_IMAGES = Images(np.zeros(0, np.int64), np.zeros(0, np.int32), (), lambda _: np.zeros((0, 0)))


def apply_camera_file(recording: Recording, path: Path) -> Recording:
    """Apply the calibrations of a camera file, and add the image folders that it names.

    Raises:
        InputError: the file is invalid, or names a camera or images that do not exist.
    """
    images = recording.images or _NO_IMAGES
    recorded = [camera.name for camera in images.cameras]
    overrides = read_camera_file(path, [*recorded, *depth_camera_names(recording.source)])
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
