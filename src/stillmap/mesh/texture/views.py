"""The pictures of a recording from which colours can be taken, each with the place it was taken
from.

One picture, and where it was taken.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2, se3
from stillmap.core.camera import Camera, Images, calibration_error
from stillmap.core.config import option
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.slam.deskew import MAX_SPEED, MAX_TURN_RATE

Index = NDArray[np.intp]

Mask = NDArray[np.bool_]

Tell = Callable[[int, int], None]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class View:
    """A picture that can be used: of a known lens, from a known place.

    Attributes:
        image: its number in the recording's images.
        stamp_ns: when it was taken, by the clock of the scans.
        camera: that took it; `K` and `T_base_camera` are known.
        T_camera_map: (4, 4) from the map frame to the camera's: x right, y down, z ahead.
    """

    image: int
    stamp_ns: int
    camera: Camera
    T_camera_map: Float

    @property
    def position(self) -> Float:
        """(3,) metres, where the camera was in the map frame."""
        R, t = self.T_camera_map[:3, :3], self.T_camera_map[:3, 3]
        return np.asarray(-R.T @ t)

    def to_camera(self, points: Float) -> Float:
        """(n, 3) metres in the camera's frame, of points (n, 3) in the map frame."""
        return np.asarray(points @ self.T_camera_map[:3, :3].T + self.T_camera_map[:3, 3])


_TRIED = 5  # pictures of a camera that are looked at to find one that can be read

_STILL = (0.02, np.radians(0.5))  # m, rad: who moved less over a pause stood

UNREADABLE = "pictures that cannot be read"

_BEYOND = "taken when nobody knows where the robot was"

_PAUSE = "taken in a pause of the scans, after which the robot was elsewhere"

_LEAP = "taken where the poses leap"


@dataclass(frozen=True)
class ViewOptions:
    """Which pictures are of a known place."""

    pause: float = option(
        1.0, "s: between scans farther apart, pictures are used only where the robot stood"
    )
    beyond: float = option(
        0.1, "s: how long before or after a scan a picture may be taken where that is all there is"
    )

    def __post_init__(self) -> None:
        if not (self.pause > 0.0 and self.beyond >= 0.0):
            raise ValueError("pause must be positive, and beyond not negative")


def find_views(
    recording: Recording, poses: Float, options: ViewOptions | None = None
) -> tuple[list[View], dict[str, int]]:
    """Pictures with a calibrated lens and a known place, and why the others are left out.

    The robot is taken to go evenly, along a screw, from scan to scan. A picture counts as taken at
    once: the rolling shutter of many cameras is not heeded. Of each camera one picture is read, to
    know of which kind they are.

    Args:
        recording: with or without images.
        poses: (T, 4, 4) T_map_base at the stamps of the scans.
        options: see ViewOptions.

    Returns:
        The views in the order of the images; how many images are left out, by reason.
    """
    images = recording.images
    if images is None or not len(images):
        return [], {}
    options = options or ViewOptions()
    cameras = [_usable(images, number) for number in range(len(images.cameras))]
    T_map_base, why_not = interpolate_poses(recording.stamp_ns, poses, images.stamp_ns, options)
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


def usable_images(recording: Recording) -> tuple[Mask, dict[str, int]]:
    """(N,) which images could be used, were the poses known; and how many could not, by reason."""
    out = np.zeros(0 if recording.images is None else len(recording.images), np.bool_)
    if recording.dimension != 3:
        return out, {"of a recording in 2D": len(out)} if len(out) else {}
    still = np.broadcast_to(np.eye(4), (recording.n_scans, 4, 4))
    views, left_out = find_views(recording, still)
    out[[view.image for view in views]] = True
    return out, left_out


def filter_readable(
    images: Images | None, views: Sequence[View], tell: Tell | None = None
) -> tuple[list[View], list[str]]:
    """The views whose pictures can be read, and for each of the others a line that says why not.

    Args:
        images: of the recording; None: there are none, and no views.
        views: some of them.
        tell: called with how many are read, and of how many.
    """
    kept, unread = list[View](), list[str]()
    for number, view in enumerate(views):
        assert images is not None
        try:
            as_color_image(images.read(view.image), view)
            kept.append(view)
        except InputError as error:
            unread.append(str(error))
        if tell is not None:
            tell(number + 1, len(views))
    return kept, unread


def read_color_image(images: Images, view: View) -> NDArray[np.uint8] | None:
    """(height, width, 3) the picture of a view; None where it is damaged, or no longer there."""
    try:
        return as_color_image(images.read(view.image), view)
    except InputError:
        return None


def as_color_image(picture: NDArray[Any], view: View) -> NDArray[np.uint8]:
    """(height, width, 3) the picture of a view with three colours.

    Args:
        picture: (height, width[, 3 or more]) as it was read.
        view: which it is of.

    Raises:
        InputError: it is not of 8 bits, or not as large as its camera's pictures.
    """
    camera = view.camera
    if picture.shape[:2] != (camera.height, camera.width) or picture.dtype != np.uint8:
        what = f"picture {view.image} is {picture.shape} {picture.dtype}, and not what its camera"
        raise InputError(f"{what} takes: {camera.height} by {camera.width} of 8 bits")
    if picture.ndim == 2:
        return np.repeat(picture[:, :, None], 3, axis=2)
    return np.broadcast_to(picture[:, :, :3], (*picture.shape[:2], 3))


def interpolate_poses(
    stamp_ns: NDArray[np.int64], poses: Float, wanted_ns: NDArray[np.int64], options: ViewOptions
) -> tuple[Float, list[str]]:
    """Where the robot was at other times than its scans'.

    Args:
        stamp_ns: (T,) of the scans, non-decreasing.
        poses: (T, 4, 4) there.
        wanted_ns: (n,).
        options: see ViewOptions.

    Returns:
        (n, 4, 4) poses; and of each why it is not to be used, "" if it is.
    """
    n = len(wanted_ns)
    if not len(stamp_ns):
        return np.tile(np.eye(4), (n, 1, 1)), [_BEYOND] * n
    # of scans with one stamp (two lasers) the last before, the first after
    right = np.searchsorted(stamp_ns, wanted_ns, side="left")
    left = np.searchsorted(stamp_ns, wanted_ns, side="right") - 1
    inside = (left >= 0) & (right < len(stamp_ns))
    away_ns = _away(stamp_ns, wanted_ns)
    near = away_ns <= round(options.beyond * 1e9)
    left, right = _pair(stamp_ns, left, right)
    seconds = 1e-9 * (stamp_ns[right] - stamp_ns[left])
    twist = se3.log(se2.inverse(poses[left]) @ poses[right])
    moved, turned = np.linalg.norm(twist[:, :3], axis=1), np.linalg.norm(twist[:, 3:], axis=1)
    pause = seconds > options.pause
    stood = (moved <= _STILL[0]) & (turned <= _STILL[1])
    leap = (moved > MAX_SPEED * seconds) | (turned > MAX_TURN_RATE * seconds)
    share = np.divide(
        1e-9 * (wanted_ns - stamp_ns[left]), seconds, out=np.zeros(n), where=seconds > 0.0
    )
    # outside of the scans, motion over a pause says nothing
    share = np.where(~inside & pause, np.round(np.clip(share, 0.0, 1.0)), share)
    T = poses[left] @ se3.exp(share[:, None] * twist)
    reasons = np.full(n, "", object)
    reasons[leap & (away_ns > 0)] = _LEAP
    reasons[inside & pause & ~stood & ~near] = _PAUSE
    reasons[~inside & ~near] = _BEYOND
    return T, reasons.tolist()


def _away(stamp_ns: NDArray[np.int64], wanted_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """(n,) nanoseconds to the nearest scan."""
    right = np.minimum(np.searchsorted(stamp_ns, wanted_ns), len(stamp_ns) - 1)
    left = np.maximum(right - 1, 0)
    ways = np.abs(wanted_ns - stamp_ns[left]), np.abs(wanted_ns - stamp_ns[right])
    return np.asarray(np.minimum(*ways))


def _pair(stamp_ns: NDArray[np.int64], left: Index, right: Index) -> tuple[Index, Index]:
    """(n,), (n,) the scans whose motion is used: those around, at the ends the two outermost."""
    last = len(stamp_ns) - 1
    # the first scan of the last two stamps, the last of the first two
    before_last = max(int(np.searchsorted(stamp_ns, stamp_ns[-1])) - 1, 0)
    second = min(int(np.searchsorted(stamp_ns, stamp_ns[0], side="right")), last)
    early, late = left < 0, right > last
    left = np.where(early, second - 1 if second else 0, np.where(late, before_last, left))
    right = np.where(early, second, np.where(late, last, right))
    return left, right


def _usable(images: Images, number: int) -> tuple[Camera | None, str]:
    """The camera, its size as its pictures have it; or why its pictures cannot be used."""
    camera = images.cameras[number]
    why = calibration_error(camera)
    if why:
        return None, why
    if camera.T_base_camera is None:
        return None, "a camera of which nobody knows where it sits"
    if not np.isfinite(camera.T_base_camera).all():
        return None, "a camera whose place is not finite"
    picture = _first(images, number)
    if picture is None:
        return None, UNREADABLE
    if picture.dtype != np.uint8 or picture.ndim not in (2, 3):
        return None, "pictures without colours (depth, or 16 bits)"
    height, width = picture.shape[:2]
    if (camera.width, camera.height) == (0, 0):
        return replace(camera, width=width, height=height), ""
    if (camera.width, camera.height) != (width, height):
        other = f"{camera.width} x {camera.height}"
        return None, f"pictures of {width} x {height} pixels, calibrated for {other}"
    return camera, ""


def _first(images: Images, number: int) -> NDArray[Any] | None:
    """A picture of a camera; None where the first few cannot be read."""
    for image in np.flatnonzero(images.camera == number)[:_TRIED].tolist():
        try:
            return images.read(image)
        except InputError:
            continue
    return None
