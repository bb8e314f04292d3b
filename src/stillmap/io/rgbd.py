"""Folders of RGB-D cameras: 7-Scenes, 3DMatch and TUM RGB-D.

Every depth image becomes a scan: a grid of beams, row by row from the upper left, unusable ones
included. The base frame of the robot is the depth camera, rotated to x ahead, y left, z up.

7-Scenes and 3DMatch: `frame-000000.color.png`, `.depth.png` (millimetres), `.pose.txt` (4 x 4,
camera to world), `camera-intrinsics.txt` there or in the folder above. TUM RGB-D: `depth.txt` and
`rgb.txt` (lines of stamp and file), `groundtruth.txt` (lines of stamp and pose).
"""

import re
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import camera as camera_module
from stillmap.core import se2, se3
from stillmap.core.array_types import Bool, Float, Float32, Int64
from stillmap.core.camera import Camera, Images
from stillmap.core.errors import InputError, advise
from stillmap.core.input_files import InputFile
from stillmap.core.recording import Recording
from stillmap.core.source import SensorNotes, Source
from stillmap.core.timestamps import parse_ns
from stillmap.io import cameras
from stillmap.io.builder import ReadContext
from stillmap.io.cameras import CameraOverride, read_image, read_image_size
from stillmap.io.point_cloud.clouds import Cloud, CloudSource, build_recording, reject
from stillmap.io.rgbd_calibration import calibrate_color_camera
from stillmap.io.text_lines import read_lines
from stillmap.io.trajectory import read_tum, rigid_transform
from stillmap.prepare.options import ReadOptions

SCENES, TUM = "7-Scenes", "TUM RGB-D"

# focal length and centre that are assumed, pixels; depth units per metre
_USUAL = {SCENES: (585.0, 320.0, 240.0, 1000.0), TUM: (525.0, 319.5, 239.5, 5000.0)}
_FRAME = re.compile(r"frame-([0-9]{1,9})\.(depth|color)\.(png|jpg|jpeg)")
_INTRINSICS = ("camera-intrinsics.txt", "camera.txt")
_RATE = 30  # images per second where no file holds stamps
_MAX_POSE_GAP_NS = 100_000_000  # between an image and the poses around it


class Frames(NamedTuple):
    """Contents of a folder.

    Attributes:
        format: name of the format.
        depth, color: stamps (ns) and files, ordered by stamp.
        T_world_camera: poses of the depth images, (4, 4) or None; x right, y down, z ahead.
        K: (3, 3) intrinsics of the depth camera; None where no file holds them.
        warnings: on what could not be used.
    """

    format: str
    depth: list[tuple[int, Path]]
    color: list[tuple[int, Path]]
    T_world_camera: list[Float | None]
    K: Float | None
    warnings: list[str]


def detect_layout(path: Path) -> str | None:
    """SCENES, TUM, or None for other folders."""
    try:
        if (path / "depth.txt").is_file() and (path / "depth").is_dir():
            return TUM
        names = (entry.name for entry in path.iterdir())
        matches = (_FRAME.fullmatch(name) for name in names)
        return SCENES if any(match and match[2] == "depth" for match in matches) else None
    except OSError:
        return None


def list_frames(path: Path) -> Frames:
    """List the images and poses of a folder.

    Raises:
        InputError: there are no depth images.
    """
    return _list_tum(path) if detect_layout(path) == TUM else _list_scenes(path)


def _list_scenes(path: Path) -> Frames:
    by_kind: dict[str, list[tuple[int, Path]]] = {"depth": [], "color": []}
    for entry in path.iterdir():
        match = _FRAME.fullmatch(entry.name)
        if match:
            stamp_ns = (int(match[1]) * 10**9 + _RATE // 2) // _RATE
            by_kind[match[2]].append((stamp_ns, entry))
    depth = sorted(by_kind["depth"])
    if not depth:
        raise InputError("holds no frame-NNNNNN.depth.png", where=str(path))
    warnings = [f"no file holds stamps: images are taken {_RATE} per second, by their numbers"]
    color, poses = sorted(by_kind["color"]), [_read_pose(file) for _, file in depth]
    return Frames(SCENES, depth, color, poses, _read_intrinsics(path, warnings), warnings)


def _read_pose(depth: Path) -> Float | None:
    """The pose in the file beside a depth image; None where there is no valid one."""
    numbers = _read_matrix(depth.with_name(depth.name.partition(".")[0] + ".pose.txt"), 16)
    try:
        return None if numbers is None else rigid_transform(numbers[:3, :3], numbers[:3, 3])
    except ValueError:  # lost tracking is marked by NaN
        return None


def _read_intrinsics(path: Path, warnings: list[str]) -> Float | None:
    for folder in (path, Path(path.absolute()).parent):
        for name in _INTRINSICS:
            if not (folder / name).is_file():
                continue
            K = _read_matrix(folder / name, 9)
            if K is not None and np.isfinite(K).all() and K[0, 0] > 0.0 and K[1, 1] > 0.0:
                return K
            warnings.append(f"{name} is not used: it holds no 3 x 3 matrix")
    return None


def _read_matrix(path: Path, count: int) -> Float | None:
    """The square matrix of `count` numbers in a text file; None where there is none."""
    try:
        if not path.is_file():
            return None
        with InputFile(path) as file:
            words = file.read(1 << 12).split()
        n = round(count**0.5)
        return np.array([float(word) for word in words]).reshape(n, n)
    except (InputError, OSError, ValueError):
        return None


def _list_tum(path: Path) -> Frames:
    warnings: list[str] = []
    depth = _read_list(path / "depth.txt", warnings)
    if not depth:
        raise InputError("lists no image", where=str(path / "depth.txt"))
    has_color = (path / "rgb.txt").is_file()
    color = _read_list(path / "rgb.txt", warnings) if has_color else []
    stamps = np.array([stamp for stamp, _ in depth], np.int64)
    poses = _interpolate_tum_poses(path / "groundtruth.txt", stamps, warnings)
    return Frames(TUM, depth, color, poses, _read_intrinsics(path, warnings), warnings)


def _read_list(path: Path, warnings: list[str]) -> list[tuple[int, Path]]:
    """Stamps and files of a list; other lines are counted in a warning."""
    out, bad = [], 0
    for line in read_lines(path):
        words = line.text.decode("utf-8", "replace").split()
        if not words or words[0].startswith("#"):
            continue
        try:
            stamp, name = words
            if Path(name).is_absolute() or ".." in Path(name).parts or "\0" in name:
                raise ValueError("leads out of the folder")
            out.append((parse_ns(stamp), path.parent / name))
        except ValueError:
            bad += 1
    if bad:
        warnings.append(f"{path.name}: {bad} lines are not a stamp and a file of the folder")
    return sorted(out, key=lambda pair: pair[0])


def _interpolate_tum_poses(path: Path, stamps: Int64, warnings: list[str]) -> list[Float | None]:
    """Poses at stamps (n,), interpolated on SE(3) between the recorded ones; None: none near."""
    if not path.is_file():
        return [None] * len(stamps)
    try:
        known_ns, poses = read_tum(path)
    except InputError as error:
        warnings.append(f"poses are not used: {error}")
        return [None] * len(stamps)
    order = np.argsort(known_ns, kind="stable")
    known_ns, poses = known_ns[order], poses[order]
    right = np.clip(np.searchsorted(known_ns, stamps), 0, len(known_ns) - 1)
    left = np.where((known_ns[right] > stamps) & (right > 0), right - 1, right)
    gap = (known_ns[right] - known_ns[left]).astype(np.float64)
    share = np.divide(stamps - known_ns[left], gap, out=np.zeros(len(stamps)), where=gap > 0.0)
    T = poses[left] @ se3.exp(share[:, None] * se3.log(se2.inverse(poses[left]) @ poses[right]))
    away = np.maximum(stamps - known_ns[left], known_ns[right] - stamps)
    near = np.abs(away) <= _MAX_POSE_GAP_NS
    return [pose if is_near else None for pose, is_near in zip(T, near.tolist(), strict=True)]


# rotation of a camera (x right, y down, z ahead) that faces ahead
T_BASE_CAMERA = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
COLOR, DEPTH = "color", "depth"  # names of the cameras

_MAX_DEPTH = 5.0  # m: structured light gives no reliable depth beyond
_MAX_UNITS = 65535  # of 16 bits: 7-Scenes has it where depth is unknown


class _Grid(NamedTuple):
    """Back-projection of depth images.

    Attributes:
        width, height: pixels of the images.
        step: see ReadOptions.depth_step.
        rays: (rows, columns, 3) float32, points in the base frame at a depth of one metre.
        scale: units per metre.
    """

    width: int
    height: int
    step: int
    rays: Float32
    scale: float


def read(path: Path, context: ReadContext) -> Recording:
    """Read a folder of depth images, with the color images and poses that it holds.

    Where at least half of the depth images have a pose, the others are skipped.

    Raises:
        InputError: no depth image can be read.
    """
    frames, options = list_frames(path), context.options
    overrides = {}
    if options.cameras is not None:
        overrides = cameras.read_camera_file(Path(options.cameras), (DEPTH, COLOR))
    notes = Source(str(path), format=frames.format, warnings=list(frames.warnings))
    depth = read_depth_camera(frames, overrides, notes.warnings)
    grid = _make_grid(depth, options, options.depth_scale or _USUAL[frames.format][-1])
    sources = _list_sources(frames, depth, grid)
    may_differ = frames.format == SCENES
    may_differ &= overrides.keys().isdisjoint((COLOR, DEPTH))
    images = _read_color_images(frames, depth, grid.scale if may_differ else None, notes.warnings)
    rows, columns = grid.rays.shape[:2]
    notes.sensors, notes.max_range = [SensorNotes(DEPTH, grid=(rows, columns))], _MAX_DEPTH
    return build_recording(sources, notes, context, images=images)


def _list_sources(frames: Frames, depth: Camera, grid: _Grid) -> list[CloudSource]:
    assert depth.T_base_camera is not None
    T_camera_base = se2.inverse(depth.T_base_camera)
    pose_count = sum(T is not None for T in frames.T_world_camera)
    sources = []
    for (stamp_ns, file), T in zip(frames.depth, frames.T_world_camera, strict=True):
        read_cloud = partial(_read_cloud, file, None if T is None else T @ T_camera_base, grid)
        if T is None and 2 * pose_count >= len(frames.depth):
            read_cloud = partial(reject, file, "has no pose, as most others have")
        sources.append(CloudSource(file.name, read_cloud, stamp_ns))
    return sources


def read_depth_camera(
    frames: Frames, overrides: dict[str, CameraOverride], warnings: list[str]
) -> Camera:
    """The depth camera; its size is that of the first depth image that can be read.

    Raises:
        InputError: none can be read, or the calibration does not fit.
    """
    size = first_image_size(frames.depth)
    if size is None:
        raise InputError("is no image, nor is any other", where=str(frames.depth[0][1]))
    width, height = size
    recorded = Camera(DEPTH, width, height, frames.K, "", np.zeros(0), T_BASE_CAMERA)
    # depth is mostly registered to color: one camera for both
    override = overrides.get(DEPTH, overrides.get(COLOR, CameraOverride()))
    camera = override.apply_to(recorded)
    if (camera.width, camera.height) != (width, height):
        what = f"images have {width} x {height} pixels, the size given for '{DEPTH}' differs"
        raise InputError(what, where=str(frames.depth[0][1]))
    if camera.K is None:
        fx, cx, cy, _ = _USUAL[frames.format]
        camera = replace(camera, K=np.array([[fx, 0.0, cx], [0.0, fx, cy], [0.0, 0.0, 1.0]]))
        assumed = f"a focal length of {fx:g} pixels and the centre at {cx:g}, {cy:g} are assumed"
        what = f"no calibration of the depth camera: {assumed}, the default of {frames.format}"
        warnings.append(advise(what, "give that of your camera by read.cameras"))
    error = camera_module.calibration_error(camera)
    if error:
        raise InputError(f"cannot be used: {error}", where=str(frames.depth[0][1]))
    return camera


def first_image_size(images: list[tuple[int, Path]]) -> tuple[int, int] | None:
    """Width and height of the first image that can be read; None: none can."""
    for _, file in images:
        with suppress(InputError):
            return read_image_size(file)
    return None


def _make_grid(camera: Camera, options: ReadOptions, scale: float) -> _Grid:
    step = options.depth_step
    columns, rows = (np.arange(0, size, step) for size in (camera.width, camera.height))
    rays = np.empty((len(rows), len(columns), 3), np.float32)
    # some at once: they are computed with three times the memory
    some = max((1 << 20) // max(len(columns), 1), 1)
    for first in range(0, len(rows), some):
        part = np.meshgrid(columns, rows[first : first + some])
        pixels = np.stack(part, axis=-1).reshape(-1, 2).astype(np.float64)
        directions = camera_module.unproject(camera, pixels) @ T_BASE_CAMERA[:3, :3].T
        rays[first : first + some] = directions.reshape(-1, len(columns), 3)
    return _Grid(camera.width, camera.height, step, rays, scale)


def _read_cloud(file: Path, T: Float | None, grid: _Grid) -> Cloud:
    image = read_image(file)
    if image.ndim != 2 or image.dtype != np.uint16:
        raise InputError("is no depth image: 16 bits of one channel", where=str(file))
    if image.shape != (grid.height, grid.width):
        raise InputError("is of another size than the first", where=str(file))
    depth = image[:: grid.step, :: grid.step]
    usable = is_depth(depth)
    if not usable.any():
        raise InputError("holds no depth", where=str(file))
    metres = np.where(usable, depth / np.float32(grid.scale), np.float32(np.nan))
    return Cloud((grid.rays * metres[..., None]).reshape(-1, 3), T)


def is_depth(units: NDArray[np.uint16]) -> Bool:
    """Mask of the pixels of a depth image that hold a depth."""
    return np.asarray((units > 0) & (units < _MAX_UNITS))


def _read_color_images(
    frames: Frames, depth: Camera, scale: float | None, warnings: list[str]
) -> Images | None:
    """The color images; their camera is the depth camera where both have the same size.

    Args:
        frames: the folder.
        depth: the depth camera.
        scale: depth units per metre where the color camera may differ and is calibrated against
            depth; None: it is the depth camera.
        warnings: more are added.
    """
    size = first_image_size(frames.color)
    if size is None:
        return None
    width, height = size
    camera = replace(depth, name=COLOR, width=width, height=height)
    if size != (depth.width, depth.height):
        sizes = f"{width} x {height} pixels, depth images {depth.width} x {depth.height}"
        what = f"color images have {sizes}: the color camera is not calibrated"
        warnings.append(advise(what, "give its calibration by read.cameras"))
        camera = replace(camera, K=None, model="", distortion=np.zeros(0))
    elif scale is not None:
        color = dict(frames.color)
        pairs = [(file, color[stamp]) for stamp, file in frames.depth if stamp in color]
        calibrated, warning = calibrate_color_camera(depth, scale, pairs)
        camera = replace(calibrated, name=COLOR)
        warnings += [warning] if warning else []
    return cameras.images_from_files(frames.color, camera)
