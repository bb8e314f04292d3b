"""Folders of a colour and depth camera: 7-Scenes and 3DMatch, TUM RGB-D.

Every depth picture becomes a scan: a grid of beams, row by row from the upper left, unusable ones
included. The robot's base is the depth camera, turned: x ahead, y left, z up.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import camera as camera_module
from stillmap.core import se2
from stillmap.core.camera import Camera, Images
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.io import camera_file, cameras, rgbd_folders
from stillmap.io.camera_file import CameraOverride
from stillmap.io.extrinsic_calibration import calibrate_color_camera
from stillmap.io.images import read_image, read_image_size
from stillmap.io.point_cloud.gravity_alignment import align_to_gravity
from stillmap.io.point_cloud.scans import Cloud, CloudSource, DatasetInfo, build_recording
from stillmap.io.rgbd_folders import Frames
from stillmap.io.text_lines import Progress
from stillmap.preprocessing.options import ReadOptions

Float = NDArray[np.float64]

# of a camera that looks ahead: x right, y down, z ahead in it
T_BASE_CAMERA = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
COLOR, DEPTH = "color", "depth"  # names of the cameras

_NOTHING_GIVEN = CameraOverride()
_LARGEST = 65535  # of 16 bits: 7-Scenes has it where nothing is known


class _Grid(NamedTuple):
    """How depth pictures become points.

    Attributes:
        width, height: pixels of them.
        step: see ReadOptions.depth_step.
        rays: (rows, columns, 3) float32, points in the base's frame at a depth of one metre.
        scale: units per metre.
    """

    width: int
    height: int
    step: int
    rays: NDArray[np.float32]
    scale: float


def is_rgbd_folder(path: Path, head: bytes | None) -> bool:
    """Whether a folder looks like one of an RGB-D camera."""
    return head is None and rgbd_folders.detect_layout(path) is not None


def read(
    path: Path,
    options: ReadOptions,
    progress: Progress | None = None,
    scratch: Path | None = None,
) -> Recording:
    """Read a folder of depth pictures, with what colour pictures and poses there are.

    Where at least half of the depth pictures have a pose, the others are skipped. The world of
    recorded poses is turned so that z is up (see `levelled`).

    Raises:
        InputError: no depth picture can be read.
    """
    frames = rgbd_folders.list_frames(path)
    given = {}
    if options.cameras is not None:
        given = camera_file.read_camera_file(Path(options.cameras), (DEPTH, COLOR))
    known = DatasetInfo(path, frames.format, list(frames.warnings))
    depth = _depth_camera(frames, given, known.warnings)
    grid = _grid(depth, options, options.depth_scale or frames.scale)
    T_base_camera = depth.T_base_camera
    assert T_base_camera is not None
    T_camera_base = se2.inverse(T_base_camera)
    posed = sum(T is not None for T in frames.T_world_camera)
    sources = []
    for (stamp_ns, file), T in zip(frames.depth, frames.T_world_camera, strict=True):
        if T is None and 2 * posed >= len(frames.depth):
            sources.append(CloudSource(file.name, partial(_no_pose, file), stamp_ns))
        else:
            pose = None if T is None else T @ T_camera_base
            sources.append(CloudSource(file.name, partial(_cloud, file, pose, grid), stamp_ns))
    if options.max_range is None:
        options = replace(options, max_range=max(options.depth_max, options.min_range + 1e-3))
    may_register = options.register and frames.format == rgbd_folders.SCENES
    may_register &= given.keys().isdisjoint((COLOR, DEPTH))
    images = _images(frames, depth, grid.scale if may_register else None, known.warnings)
    recording = build_recording(sources, known, options, progress, scratch, images=images)
    rows, columns = grid.rays.shape[:2]
    recording.source["sensors"] = [{"name": DEPTH, "grid": [rows, columns]}]
    return align_to_gravity(recording) if options.level else recording


def _depth_camera(frames: Frames, given: dict[str, CameraOverride], warnings: list[str]) -> Camera:
    """The camera that took the depth pictures, by the first of them that can be read.

    Raises:
        InputError: none can.
    """
    width, height = _size(frames)
    found = Camera(DEPTH, width, height, frames.K, "", np.zeros(0), T_BASE_CAMERA)
    # depth is mostly laid over the colours: one camera for both
    camera = given.get(DEPTH, given.get(COLOR, _NOTHING_GIVEN)).apply_to(found)
    if (camera.width, camera.height) != (width, height):
        what = f"pictures have {width} x {height} pixels, camera '{DEPTH}' is given others"
        raise InputError(what, where=str(frames.depth[0][1]))
    if camera.K is None:
        camera = replace(camera, K=frames.default_K)
        fx, cx, cy = frames.default_K[[0, 0, 1], [0, 2, 2]]
        warnings.append(
            f"no file says how the camera sees: a focal length of {fx:g} pixels and the centre at "
            f"{cx:g}, {cy:g} are taken, as is usual for {frames.format}; --cameras FILE has others"
        )
    why = camera_module.calibration_error(camera)
    if why:
        raise InputError(f"cannot be used: {why}", where=str(frames.depth[0][1]))
    warnings += [said] if (said := cameras.validate_camera(camera)) else []
    return camera


def _size(frames: Frames) -> tuple[int, int]:
    for _, file in frames.depth:
        try:
            return read_image_size(file)
        except InputError:
            continue
    raise InputError("is no picture, nor is any other", where=str(frames.depth[0][1]))


def _grid(camera: Camera, options: ReadOptions, scale: float) -> _Grid:
    step = options.depth_step
    columns, rows = np.meshgrid(np.arange(0, camera.width, step), np.arange(0, camera.height, step))
    pixels = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)
    rays = camera_module.unproject(camera, pixels) @ T_BASE_CAMERA[:3, :3].T
    shaped = rays.reshape(*columns.shape, 3).astype(np.float32)
    return _Grid(camera.width, camera.height, step, shaped, scale)


def _cloud(file: Path, T: Float | None, grid: _Grid) -> Cloud:
    picture = read_image(file)
    if picture.ndim != 2 or picture.dtype != np.uint16:
        raise InputError("is no depth picture: 16 bits of one channel", where=str(file))
    if picture.shape != (grid.height, grid.width):
        raise InputError("is of another size than the first", where=str(file))
    depth = picture[:: grid.step, :: grid.step]
    usable = (depth > 0) & (depth < _LARGEST)
    if not usable.any():
        raise InputError("holds no depth", where=str(file))
    metres = np.where(usable, depth / np.float32(grid.scale), np.float32(np.nan))
    return Cloud((grid.rays * metres[..., None]).reshape(-1, 3), T)


def _no_pose(file: Path) -> Cloud:
    raise InputError("has no pose, as most others have", where=str(file))


def _images(
    frames: Frames, depth: Camera, scale: float | None, warnings: list[str]
) -> Images | None:
    """The colour pictures; their camera is that of depth where they are as large.

    Args:
        frames: the folder.
        depth: the camera of depth.
        scale: units of depth per metre, if it is in question whether both are one; else None.
        warnings: more are added.
    """
    for _, file in frames.color:
        try:
            width, height = read_image_size(file)
        except InputError:
            continue
        camera = replace(depth, name=COLOR, width=width, height=height)
        if (width, height) != (depth.width, depth.height):
            warnings.append(
                f"colour has {width} x {height} pixels, depth {depth.width} x {depth.height}: how "
                "the colour camera sees is not known; --cameras FILE says so"
            )
            camera = replace(camera, K=None, model="", distortion=np.zeros(0))
        elif scale is not None:
            colour = dict(frames.color)
            pairs = [(file, colour[stamp]) for stamp, file in frames.depth if stamp in colour]
            beside, said = calibrate_color_camera(depth, scale, pairs)
            camera = replace(beside, name=COLOR)
            warnings += [said] if said else []
        return cameras.images_from_files(frames.color, camera)
    return None
