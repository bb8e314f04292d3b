"""stillmap's recording folder: `recording.json`, arrays as `.npy` files, images as PNG files.

While a drive lasts the header says `open`, and the files count: the last whole scan ends it.
Images of floats (depth in metres) are `.npy` files of float32.
"""

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from stillmap.core.array_folder import (
    count_rows,
    open_npy,
    parse,
    read_array,
    read_poses,
    read_record,
    write_arrays,
)
from stillmap.core.array_types import Bool, Float, Float32
from stillmap.core.arrays import iter_blocks, write_npy
from stillmap.core.camera import Camera, Images
from stillmap.core.errors import InputError, explaining_damage
from stillmap.core.files import atomic_folder
from stillmap.core.recording import Recording
from stillmap.core.source import Source
from stillmap.io.cameras import read_image, write_png
from stillmap.io.trajectory import MAX_TRANSLATION
from stillmap.prepare.options import MAX_POINT_DISTANCE

HEADER = "recording.json"
FORMAT = "stillmap-recording"

_IMAGES = "images"
_OPTIONAL = {  # arrays that may be missing, by the entry of the header that says so
    "odometry": "T_odom_base",
    "beam_times": "beam_time",
    "recorded_poses": "T_recorded_base",
}
_ARRAYS = ("stamp_ns", "offset", "points", "hit", "T_base_sensor", "sensor", *_OPTIONAL.values())
_MAX_HEADER = 16 << 20  # bytes: parsed JSON of empty lists takes thirty times as many
_Count = Annotated[int, Meta(ge=0, lt=1 << 60)]
_Pixels = Annotated[int, Meta(ge=1, le=1 << 16)]
_Number = Annotated[float, Meta(ge=-1e300, le=1e300)]
_Matrix = list[list[_Number]]


@dataclass
class _CameraHeader:
    name: str
    width: _Pixels
    height: _Pixels
    K: _Matrix | None
    model: str
    distortion: list[_Number]
    T_base_camera: _Matrix | None


@dataclass
class _Header:
    dimension: Literal[2, 3]
    scans: _Count
    beams: _Count
    sensors: _Count
    odometry: bool = False
    beam_times: bool = False
    recorded_poses: bool = False
    open: bool = False
    images: _Count | None = None
    cameras: list[_CameraHeader] = field(default_factory=list)
    source: Any = None


def _write_images(images: Images, folder: Path) -> tuple[dict[str, Any], list[str]]:
    """Write images, stamps and cameras into an existing folder.

    Returns:
        Header entries, and a warning where images could not be read and are left out.
    """
    (folder / _IMAGES).mkdir()
    kept: list[int] = []
    lost: list[str] = []
    for image in range(len(images)):
        try:
            pixels = images.read(image)
        except InputError as error:
            lost.append(str(error))
            continue
        path = folder / _IMAGES / f"{len(kept):06d}"
        if pixels.dtype.kind == "f":
            write_npy(path.with_suffix(".npy"), pixels.astype(np.float32))
        else:
            write_png(pixels, path.with_suffix(".png"))
        kept.append(image)
    write_npy(folder / "image_stamp_ns.npy", images.stamp_ns[kept])
    write_npy(folder / "image_camera.npy", images.camera[kept])
    cameras = [
        {name: np.array(value).tolist() for name, value in vars(camera).items()}
        for camera in images.cameras
    ]
    warnings = [f"{len(lost)} images left out: {lost[0]}"] if lost else []
    return {"images": len(kept), "cameras": cameras}, warnings


def _read_images(path: Path, header: _Header) -> Images | None:
    """The images of a recording folder, each read on demand."""
    if header.images is None:
        return None
    stamp_ns = np.array(read_array(path / "image_stamp_ns.npy", (header.images,), np.int64))
    camera = np.array(read_array(path / "image_camera.npy", (header.images,), np.int32))
    cameras = []
    for noted in header.cameras:
        K, T = _matrix(noted.K, 3), _matrix(noted.T_base_camera, 4)
        distortion, own = np.array(noted.distortion, np.float64), Camera(**vars(noted))
        cameras.append(replace(own, K=K, distortion=distortion, T_base_camera=T))
    return Images(stamp_ns, camera, tuple(cameras), partial(_load_image, path / _IMAGES))


def _matrix(rows: Any, n: int) -> Float | None:
    return None if rows is None else np.array(rows, np.float64).reshape(n, n)


def _load_image(folder: Path, image: int) -> NDArray[Any]:
    path = folder / f"{image:06d}.npy"
    png = path.with_suffix(".png")
    if png.exists() or not path.exists():
        return read_image(png)
    pixels = open_npy(path)
    if pixels.dtype != np.float32 or pixels.ndim != 2:
        raise InputError(f"is damaged: {pixels.shape} {pixels.dtype}", where=str(path))
    return np.array(pixels)


def write(recording: Recording, path: str | Path, overwrite: bool = False) -> list[str]:
    """Write a recording folder atomically; nothing is left out.

    Raises:
        InputError: `path` is not empty, or cannot be written.
    """
    with atomic_folder(Path(path), HEADER, overwrite) as work:
        write_into(recording, work)
    return []


def write_into(recording: Recording, folder: Path) -> None:
    """Write the files of a recording into an existing folder."""
    image_header: dict[str, Any] = {}
    source = recording.source
    if recording.images is not None:
        image_header, warnings = _write_images(recording.images, folder)
        source = replace(source, warnings=[*source.warnings, *warnings])
    header = {
        "format": FORMAT,
        "dimension": recording.dimension,
        "scans": recording.n_scans,
        "beams": recording.n_beams,
        "sensors": len(recording.T_base_sensor),
        **{entry: getattr(recording, name) is not None for entry, name in _OPTIONAL.items()},
        **image_header,
        "source": source.to_dict(),
    }
    write_arrays(folder, {name: getattr(recording, name) for name in _ARRAYS}, HEADER, header)


def read(path: Path, scratch: Path | None = None) -> Recording:
    """Read a recording folder; large arrays are memory-mapped copies in the folder `scratch`.

    None is the system's temporary folder.

    Raises:
        InputError: a file is missing, damaged, or inconsistent with the others.
    """
    header, grows = _read_header(path / HEADER), False
    if header.open:
        header, grows = _count_whole_scans(path, header), True
    T, M, D = header.scans, header.beams, header.dimension

    def load(name: str, shape: tuple[int, ...], dtype: type) -> NDArray[Any]:
        return read_array(path / f"{name}.npy", shape, dtype, scratch, grows=grows)

    def load_poses(name: str, count: int) -> Float:
        return read_poses(path / f"{name}.npy", count, D, MAX_TRANSLATION, grows=grows)

    stamp_ns, offset = load("stamp_ns", (T,), np.int64), load("offset", (T + 1,), np.int64)
    points, hit = load("points", (M, D), np.float32), load("hit", (M,), np.bool_)
    # np.diff could overflow
    if np.any(stamp_ns[1:] < stamp_ns[:-1]):
        raise _damaged_error(path, "stamp_ns", "stamps decrease")
    _check_points(path, points, hit)
    with explaining_damage(path):
        return Recording(
            stamp_ns=np.array(stamp_ns),
            offset=np.array(offset),
            points=points,
            hit=hit,
            T_base_sensor=load_poses("T_base_sensor", header.sensors),
            sensor=np.array(load("sensor", (T,), np.int32)),
            T_odom_base=load_poses("T_odom_base", T) if header.odometry else None,
            source=Source.from_dict(header.source),
            beam_time=load("beam_time", (M,), np.float32) if header.beam_times else None,
            T_recorded_base=load_poses("T_recorded_base", T) if header.recorded_poses else None,
            images=_read_images(path, header),
        )


def _count_whole_scans(path: Path, header: _Header) -> _Header:
    """The header of a folder that is still written, or whose writing was interrupted.

    Raises:
        InputError: there is none, or a file is missing.
    """
    names = ["stamp_ns", "sensor", *(["T_odom_base"] if header.odometry else [])]
    scans = min(count_rows(path / f"{name}.npy") for name in names)
    names = ["points", "hit", *(["beam_time"] if header.beam_times else [])]
    beams = min(count_rows(path / f"{name}.npy") for name in names)
    ends = min(count_rows(path / "offset.npy"), scans + 1)
    offset = open_npy(path / "offset.npy", rows=ends)
    if offset.dtype != np.int64 or offset.ndim != 1 or np.any(offset[1:] < offset[:-1]):
        raise _damaged_error(path, "offset", "must rise")
    scans = int(np.searchsorted(offset, beams, side="right")) - 1
    if scans < 1:
        raise InputError("holds no whole scan", where=str(path))
    return replace(header, scans=scans, beams=int(offset[scans]))


def has_beam_times(path: Path) -> bool:
    """True if a recording folder has the time of each beam.

    Raises:
        InputError: its header is missing or damaged.
    """
    return _read_header(path / HEADER).beam_times


def _read_header(path: Path) -> _Header:
    record = read_record(path, max_bytes=_MAX_HEADER)
    if record.get("format") != FORMAT:
        raise InputError(f"is not the header of a {FORMAT}", where=str(path))
    return parse(record, _Header, path)


def _check_points(path: Path, points: Float32, hit: Bool) -> None:
    for block in iter_blocks(points, hit):
        is_known = (np.abs(points[block]) <= MAX_POINT_DISTANCE).all(axis=1)
        is_unusable = np.isnan(points[block]).any(axis=1) & ~hit[block]
        if not np.all(is_known | is_unusable):
            what = f"a beam's end is not finite, or farther than {MAX_POINT_DISTANCE:.0f} m away"
            raise _damaged_error(path, "points", what)


def _damaged_error(path: Path, name: str, what: str) -> InputError:
    return InputError(f"is damaged: {what}", where=str(path / f"{name}.npy"))
