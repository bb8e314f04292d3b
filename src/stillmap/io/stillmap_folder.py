"""stillmap's recording folder: `recording.json`, arrays as `.npy` files, images as PNG files.

While a drive lasts the header says `open`, and the files count: the last whole scan ends it.
Images of floats (depth in metres) are `.npy` files of float32.
"""

import json
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, NotRequired

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, FiniteFloat
from typing_extensions import TypedDict

from stillmap.core.array_folder import count_rows, open_npy, parse, read_array, read_poses
from stillmap.core.arrays import iter_blocks, write_npy
from stillmap.core.camera import Camera, Images
from stillmap.core.errors import InputError
from stillmap.core.files import atomic_folder
from stillmap.core.json import read_json
from stillmap.core.recording import Recording
from stillmap.io.images import read_image, write_png
from stillmap.io.notes import prune_notes
from stillmap.io.rigid_transforms import MAX_TRANSLATION
from stillmap.prepare.options import MAX_POINT_DISTANCE

_IMAGES = "images"


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
        {
            name: value.tolist() if isinstance(value, np.ndarray) else value
            for name, value in vars(camera).items()
        }
        for camera in images.cameras
    ]
    warnings = [f"{len(lost)} images left out: {lost[0]}"] if lost else []
    return {"images": len(kept), "cameras": cameras}, warnings


def _read_images(path: Path, header: dict[str, Any]) -> Images | None:
    """The images of a recording folder, each read on demand."""
    if "images" not in header:
        return None
    N = header["images"]
    stamp_ns = np.array(read_array(path / "image_stamp_ns.npy", (N,), np.int64))
    camera = np.array(read_array(path / "image_camera.npy", (N,), np.int32))
    try:
        cameras = tuple(_camera_from_dict(one) for one in header.get("cameras", ()))
        return Images(stamp_ns, camera, cameras, partial(_load_image, path / _IMAGES))
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"is damaged: its cameras: {error}", where=str(path)) from error


def _camera_from_dict(one: dict[str, Any]) -> Camera:
    return Camera(
        name=one["name"],
        width=one["width"],
        height=one["height"],
        K=_matrix(one["K"], 3),
        model=one["model"],
        distortion=np.array(one["distortion"], np.float64).reshape(-1),
        T_base_camera=_matrix(one["T_base_camera"], 4),
    )


def _matrix(rows: Any, n: int) -> NDArray[np.float64] | None:
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


HEADER = "recording.json"
FORMAT = "stillmap-recording"
FORMAT_VERSION = 1
_Count = Annotated[int, Field(ge=0, lt=1 << 60)]
_Pixels = Annotated[int, Field(ge=1, le=1 << 16)]
_Row = list[FiniteFloat]


class _CameraHeader(TypedDict):
    name: str
    width: _Pixels
    height: _Pixels
    K: list[_Row] | None
    model: str
    distortion: _Row
    T_base_camera: list[_Row] | None


class _Header(TypedDict):
    dimension: Literal[2, 3]
    scans: _Count
    beams: _Count
    sensors: _Count
    odometry: NotRequired[bool]
    beam_times: NotRequired[bool]
    recorded_poses: NotRequired[bool]
    open: NotRequired[bool]
    images: NotRequired[_Count]
    cameras: NotRequired[list[_CameraHeader]]


_ARRAYS = (
    *("stamp_ns", "offset", "points", "hit", "T_base_sensor", "sensor"),
    *("T_odom_base", "beam_time", "T_recorded_base"),
)
_MAX_HEADER = 16 << 20  # bytes: parsed JSON of empty lists takes thirty times as many


def write(recording: Recording, path: str | Path, *, overwrite: bool = False) -> None:
    """Write a recording folder atomically.

    Raises:
        InputError: `path` is not empty, or cannot be written.
    """
    with atomic_folder(Path(path), HEADER, overwrite) as work:
        write_into(recording, work)


def write_into(recording: Recording, folder: Path) -> None:
    """Write the files of a recording into an existing folder."""
    image_header: dict[str, Any] = {}
    source = recording.source
    if recording.images is not None:
        image_header, warnings = _write_images(recording.images, folder)
        if warnings:
            source = {**source, "warnings": [*source.get("warnings", []), *warnings]}
    header = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "dimension": recording.dimension,
        "scans": recording.n_scans,
        "beams": recording.n_beams,
        "sensors": len(recording.T_base_sensor),
        "odometry": recording.T_odom_base is not None,
        "beam_times": recording.beam_time is not None,
        "recorded_poses": recording.T_recorded_base is not None,
        **image_header,
        "source": source,
    }
    text = json.dumps(header, indent=1, allow_nan=False)
    for name in _ARRAYS:
        if getattr(recording, name) is not None:
            write_npy(folder / f"{name}.npy", getattr(recording, name))
    (folder / HEADER).write_text(text + "\n", encoding="utf-8")


def read(path: Path, scratch: Path | None = None) -> Recording:
    """Read a recording folder; large arrays are memory-mapped copies in the folder `scratch`.

    None is the system's temporary folder.

    Raises:
        InputError: a file is missing, damaged, or inconsistent with the others.
    """
    header = _read_header(path / HEADER)
    grows = bool(header.get("open"))
    if grows:
        header |= _count_whole_scans(path, header)
    T, M, S, D = (header[key] for key in ("scans", "beams", "sensors", "dimension"))

    def read_own(name: str, *shape: int, dtype: type, scratch: Path | None = None) -> NDArray[Any]:
        return read_array(path / f"{name}.npy", shape, dtype, scratch, grows)

    def read_own_poses(name: str, count: int) -> NDArray[np.float64]:
        return read_poses(path / f"{name}.npy", count, D, MAX_TRANSLATION, grows)

    stamp_ns = np.array(read_own("stamp_ns", T, dtype=np.int64))
    offset = np.array(read_own("offset", T + 1, dtype=np.int64))
    # np.diff could overflow
    if np.any(stamp_ns[1:] < stamp_ns[:-1]):
        raise _damaged_error(path, "stamp_ns", "stamps decrease")
    if offset[0] != 0 or offset[-1] != M or np.any(offset[1:] < offset[:-1]):
        raise _damaged_error(path, "offset", f"must rise from 0 to {M}")
    points = read_own("points", M, D, dtype=np.float32, scratch=scratch)
    hit = read_own("hit", M, dtype=np.bool_, scratch=scratch)
    _check_points(path, points, hit)
    optional: dict[str, Any] = {"T_odom_base": None}
    for key, name in (("odometry", "T_odom_base"), ("recorded_poses", "T_recorded_base")):
        if header.get(key):
            optional[name] = read_own_poses(name, T)
    if header.get("beam_times"):
        optional["beam_time"] = read_own("beam_time", M, dtype=np.float32, scratch=scratch)
    try:
        return Recording(
            stamp_ns=stamp_ns,
            offset=offset,
            points=points,
            hit=hit,
            T_base_sensor=read_own_poses("T_base_sensor", S),
            sensor=np.array(read_own("sensor", T, dtype=np.int32)),
            source=prune_notes(header.get("source")),
            images=_read_images(path, header),
            **optional,
        )
    except ValueError as error:
        raise InputError(f"is damaged: {error}", where=str(path)) from error


def _count_whole_scans(path: Path, header: dict[str, Any]) -> dict[str, int]:
    """Scans and beams of a folder that is still written, or whose writing was interrupted.

    Raises:
        InputError: there is none, or a file is missing.
    """
    names = ["stamp_ns", "sensor", *(["T_odom_base"] if header.get("odometry") else [])]
    scans = min(count_rows(path / f"{name}.npy") for name in names)
    names = ["points", "hit", *(["beam_time"] if header.get("beam_times") else [])]
    beams = min(count_rows(path / f"{name}.npy") for name in names)
    ends = min(count_rows(path / "offset.npy"), scans + 1)
    offset = open_npy(path / "offset.npy", rows=ends)
    if offset.dtype != np.int64 or offset.ndim != 1 or np.any(offset[1:] < offset[:-1]):
        raise _damaged_error(path, "offset", "must rise")
    scans = int(np.searchsorted(offset, beams, side="right")) - 1
    if scans < 1:
        raise InputError("holds no whole scan", where=str(path))
    return {"scans": scans, "beams": int(offset[scans])}


def has_beam_times(path: Path) -> bool:
    """True if a recording folder has the time of each beam.

    Raises:
        InputError: its header is missing or damaged.
    """
    return bool(_read_header(path / HEADER).get("beam_times"))


def _read_header(path: Path) -> dict[str, Any]:
    header = read_json(path, _MAX_HEADER)
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise InputError(f"is not the header of a {FORMAT}", where=str(path))
    if header.get("format_version") != FORMAT_VERSION:
        what = f"format_version {header.get('format_version')!r} is unknown here"
        raise InputError(what, where=str(path), hint=f"this version reads {FORMAT_VERSION}")
    parse(header, _Header, path)
    return header


def _check_points(path: Path, points: NDArray[np.float32], hit: NDArray[np.bool_]) -> None:
    for block in iter_blocks(points, hit):
        chunk = points[block]
        usable = np.isfinite(chunk).all(axis=1)
        if np.any(hit[block] & ~usable) or np.any(np.isinf(chunk)):
            raise _damaged_error(path, "points", "a hit or a maximum-range beam is not finite")
        if np.any(np.abs(chunk) > MAX_POINT_DISTANCE):
            what = f"a beam ends farther than {MAX_POINT_DISTANCE:.0f} m away"
            raise _damaged_error(path, "points", what)


def _damaged_error(path: Path, name: str, what: str) -> InputError:
    return InputError(f"is damaged: {what}", where=str(path / f"{name}.npy"))
