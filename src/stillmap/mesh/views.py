"""Images of a recording with a calibrated camera and a known pose."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2, se3
from stillmap.core.array_types import Bool, Float, Int64
from stillmap.core.camera import Camera, Images, calibration_error
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.io.trajectory import bracket_times
from stillmap.mesh.triangle_mesh import Image, Tell, no_tell
from stillmap.slam.deskew import MAX_SCAN_GAP, MAX_SPEED, MAX_TURN_RATE

_MAX_IMAGE_EXTRAPOLATION = 0.1  # s before or after a scan where there is none on the other side
_TRIED = 5  # images of a camera that are tried to find a readable one
_STATIONARY = (0.02, np.radians(0.5))  # m, rad: less motion over a gap counts as none

UNREADABLE = "images that cannot be read"
_OUTSIDE = "taken outside the time of the scans"
_IN_GAP = "taken in a gap between scans in which the robot moved"
_AT_JUMP = "taken where the trajectory jumps"


@dataclass(frozen=True, eq=False)
class View(ShortRepr):
    """An image with a calibrated camera and a known pose.

    Attributes:
        image: its number in the recording's images.
        stamp_ns: when it was taken, by the clock of the scans.
        camera: with known `K` and `T_base_camera`.
        T_camera_map: (4, 4) from the map frame to the camera's: x right, y down, z ahead.
    """

    image: int
    stamp_ns: int
    camera: Camera
    T_camera_map: Float

    @property
    def position(self) -> Float:
        """(3,) metres, camera center in the map frame."""
        R, t = self.T_camera_map[:3, :3], self.T_camera_map[:3, 3]
        return np.asarray(-R.T @ t)

    def to_camera(self, points: Float) -> Float:
        """(n, 3) metres in the camera's frame, of points (n, 3) in the map frame."""
        return np.asarray(points @ self.T_camera_map[:3, :3].T + self.T_camera_map[:3, 3])

    def to_map(self, points: Float) -> Float:
        """(n, 3) metres in the map frame, of points (n, 3) in the camera's frame."""
        return np.asarray((points - self.T_camera_map[:3, 3]) @ self.T_camera_map[:3, :3])


def find_views(recording: Recording, poses: Float) -> tuple[list[View], dict[str, int]]:
    """Images with a calibrated camera and a known pose.

    Poses are interpolated along a screw between scans; rolling shutters are not modelled. One
    image per camera is read, for its size and type.

    Args:
        recording: with or without images.
        poses: (T, 4, 4) T_map_base at the stamps of the scans.

    Returns:
        The views in the order of the images; how many images are left out, by reason.
    """
    images = recording.images
    if images is None or not len(images):
        return [], {}
    cameras = [_check_camera(images, number) for number in range(len(images.cameras))]
    T_map_base, why_not = interpolate_poses(recording.stamp_ns, poses, images.stamp_ns)
    views, left_out = [], Counter[str]()
    for image, number in enumerate(images.camera.tolist()):
        camera, reason = cameras[number]
        reason = reason or why_not[image]
        if reason or camera is None:
            left_out[reason] += 1
            continue
        assert camera.T_base_camera is not None
        T_camera_map = se2.inverse(T_map_base[image] @ camera.T_base_camera)
        views.append(View(image, int(images.stamp_ns[image]), camera, T_camera_map))
    return views, dict(left_out)


def usable_images(recording: Recording) -> tuple[Bool, dict[str, int]]:
    """(N,) which images could be used if the poses were known; how many not, by reason."""
    out = np.zeros(0 if recording.images is None else len(recording.images), np.bool_)
    if recording.dimension != 3:
        return out, {"of a 2D recording": len(out)} if len(out) else {}
    identity = np.broadcast_to(np.eye(4), (recording.n_scans, 4, 4))
    views, left_out = find_views(recording, identity)
    out[[view.image for view in views]] = True
    return out, left_out


def filter_readable(
    images: Images, views: Sequence[View], tell: Tell = no_tell
) -> tuple[list[View], list[str]]:
    """The views whose images can be read, and one line of explanation for each of the others.

    Args:
        images: of the recording.
        views: to be read.
        tell: called with the number read and the total.
    """
    kept, unread = list[View](), list[str]()
    for number, view in enumerate(views):
        try:
            as_color_image(images.read(view.image), view)
            kept.append(view)
        except InputError as error:
            unread.append(str(error))
        tell(number + 1, len(views))
    return kept, unread


def read_color_image(images: Images, view: View) -> Image:
    """(height, width, 3) the image of a view, see `as_color_image`."""
    return as_color_image(images.read(view.image), view)


def as_color_image(image: NDArray[Any], view: View) -> Image:
    """(height, width, 3) an image (height, width[, 3 or more]) of a view as RGB.

    Raises:
        InputError: it is not of 8 bits, or its size is not the camera's.
    """
    camera = view.camera
    if image.shape[:2] != (camera.height, camera.width) or image.dtype != np.uint8:
        raise InputError(
            f"image {view.image}: expected {camera.height} x {camera.width} of 8 bits, "
            f"got {image.shape} {image.dtype}"
        )
    if image.ndim == 2:
        return np.repeat(image[:, :, None], 3, axis=2)
    return np.broadcast_to(image[:, :, :3], (*image.shape[:2], 3))


def interpolate_poses(stamp_ns: Int64, poses: Float, wanted_ns: Int64) -> tuple[Float, list[str]]:
    """Robot poses at other times than those of the scans.

    Args:
        stamp_ns: (T,) of the scans, non-decreasing.
        poses: (T, 4, 4) at these stamps.
        wanted_ns: (n,).

    Returns:
        (n, 4, 4) poses; and for each the reason why it is unknown, "" if it is known.
    """
    if not len(stamp_ns):
        n = len(wanted_ns)
        return np.tile(np.eye(4), (n, 1, 1)), [_OUTSIDE] * n
    stamp_ns, first = np.unique(stamp_ns, return_index=True)  # two lasers may share stamps
    poses = poses[first]
    left, right, seconds, since = bracket_times(stamp_ns, wanted_ns)
    away = np.minimum(np.abs(since), np.abs(since - seconds))
    outside, near = (since < 0.0) | (since > seconds), away <= _MAX_IMAGE_EXTRAPOLATION
    twist = se3.log(se2.inverse(poses[left]) @ poses[right])
    moved, turned = np.linalg.norm(twist[:, :3], axis=1), np.linalg.norm(twist[:, 3:], axis=1)
    gap = seconds > MAX_SCAN_GAP
    stationary = (moved <= _STATIONARY[0]) & (turned <= _STATIONARY[1])
    jump = (moved > MAX_SPEED * seconds) | (turned > MAX_TURN_RATE * seconds)
    share = np.divide(since, seconds, out=np.zeros(len(since)), where=seconds > 0.0)
    # motion over a gap is not extrapolated
    share = np.where(outside & gap, np.round(np.clip(share, 0.0, 1.0)), share)
    T = poses[left] @ se3.exp(share[:, None] * twist)
    reasons = np.full(len(since), "", object)
    reasons[jump & (away > 0.0)] = _AT_JUMP
    reasons[~outside & gap & ~stationary & ~near] = _IN_GAP
    reasons[outside & ~near] = _OUTSIDE
    return T, reasons.tolist()


def _check_camera(images: Images, number: int) -> tuple[Camera | None, str]:
    """The camera with the size of its images; or why its images cannot be used."""
    camera = images.cameras[number]
    why = calibration_error(camera)
    if why:
        return None, why
    if camera.T_base_camera is None:
        return None, "a camera without a known pose on the robot"
    if not np.isfinite(camera.T_base_camera).all():
        return None, "a camera whose pose on the robot is not finite"
    image = _first_readable(images, number)
    if image is None:
        return None, UNREADABLE
    if image.dtype != np.uint8 or image.ndim not in (2, 3):
        return None, "images without color (depth, or 16 bits)"
    height, width = image.shape[:2]
    if (camera.width, camera.height) == (0, 0):
        return replace(camera, width=width, height=height), ""
    if (camera.width, camera.height) != (width, height):
        other = f"{camera.width} x {camera.height}"
        return None, f"images of {width} x {height} pixels, calibrated for {other}"
    return camera, ""


def _first_readable(images: Images, number: int) -> NDArray[Any] | None:
    """An image of a camera; None where the first few cannot be read."""
    for image in np.flatnonzero(images.camera == number)[:_TRIED].tolist():
        try:
            return images.read(image)
        except InputError:
            continue
    return None
