"""Folders of RGB-D cameras: 7-Scenes, 3DMatch and TUM RGB-D.

Every depth image becomes a scan: a grid of beams, row by row from the upper left, unusable ones
included. The base frame of the robot is the depth camera, rotated to x ahead, y left, z up.
"""

from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import camera as camera_module
from stillmap.core import se2
from stillmap.core.camera import Camera, Images
from stillmap.core.errors import InputError, advise
from stillmap.core.recording import Recording
from stillmap.io import camera_file, cameras, rgbd_folders
from stillmap.io.builder import ReadContext
from stillmap.io.camera_file import CameraOverride
from stillmap.io.extrinsic_calibration import calibrate_color_camera
from stillmap.io.gravity_alignment import align_to_gravity
from stillmap.io.images import read_image, read_image_size
from stillmap.io.point_cloud.clouds import Cloud, CloudSource, DatasetInfo, build_recording, reject
from stillmap.io.rgbd_folders import Frames
from stillmap.prepare.options import ReadOptions

Float = NDArray[np.float64]

# rotation of a camera (x right, y down, z ahead) that faces ahead
T_BASE_CAMERA = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
COLOR, DEPTH = "color", "depth"  # names of the cameras

_MAX_DEPTH = 5.0  # m: structured light gives no reliable depth beyond
_RAYS_AT_ONCE = 1 << 20  # of a depth camera, which are computed with three times the memory
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
    rays: NDArray[np.float32]
    scale: float


def read(path: Path, context: ReadContext) -> Recording:
    """Read a folder of depth images, with the color images and poses that it holds.

    Where at least half of the depth images have a pose, the others are skipped. Recorded poses
    are rotated so that z is up (see `align_to_gravity`).

    Raises:
        InputError: no depth image can be read.
    """
    frames, options = rgbd_folders.list_frames(path), context.options
    overrides = {}
    if options.cameras is not None:
        overrides = camera_file.read_camera_file(Path(options.cameras), (DEPTH, COLOR))
    info = DatasetInfo(path, frames.format, list(frames.warnings))
    depth = read_depth_camera(frames, overrides, info.warnings)
    grid = _make_grid(depth, options, options.depth_scale or frames.scale)
    sources = _list_sources(frames, depth, grid)
    if options.max_range is None:
        nearest = max(_MAX_DEPTH, options.min_range + 1e-3)
        context = context._replace(options=replace(options, max_range=nearest))
    may_differ = frames.format == rgbd_folders.SCENES
    may_differ &= overrides.keys().isdisjoint((COLOR, DEPTH))
    images = _read_color_images(frames, depth, grid.scale if may_differ else None, info.warnings)
    recording = build_recording(sources, info, context, images=images)
    rows, columns = grid.rays.shape[:2]
    recording.source["sensors"] = [{"name": DEPTH, "grid": [rows, columns]}]
    return align_to_gravity(recording)


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
        camera = replace(camera, K=frames.default_K)
        fx, cx, cy = frames.default_K[[0, 0, 1], [0, 2, 2]]
        warnings.append(
            advise(
                f"no calibration of the depth camera: a focal length of {fx:g} pixels and the "
                f"centre at {cx:g}, {cy:g} are assumed, the default of {frames.format}",
                "give that of your camera by read.cameras",
            )
        )
    error = camera_module.calibration_error(camera)
    if error:
        raise InputError(f"cannot be used: {error}", where=str(frames.depth[0][1]))
    warnings += [warning] if (warning := cameras.validate_camera(camera)) else []
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
    some = max(_RAYS_AT_ONCE // max(len(columns), 1), 1)
    for first in range(0, len(rows), some):
        part = np.meshgrid(columns, rows[first : first + some])
        pixels = np.stack(part, axis=-1).reshape(-1, 2).astype(np.float64)
        found = camera_module.unproject(camera, pixels) @ T_BASE_CAMERA[:3, :3].T
        rays[first : first + some] = found.reshape(-1, len(columns), 3)
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


def is_depth(units: NDArray[np.uint16]) -> NDArray[np.bool_]:
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
        warnings.append(
            advise(
                f"color images have {width} x {height} pixels, depth images {depth.width} x "
                f"{depth.height}: the color camera is not calibrated",
                "give its calibration by read.cameras",
            )
        )
        camera = replace(camera, K=None, model="", distortion=np.zeros(0))
    elif scale is not None:
        color = dict(frames.color)
        pairs = [(file, color[stamp]) for stamp, file in frames.depth if stamp in color]
        calibrated, warning = calibrate_color_camera(depth, scale, pairs)
        camera = replace(calibrated, name=COLOR)
        warnings += [warning] if warning else []
    return cameras.images_from_files(frames.color, camera)
