"""Collects the headers of Image, CompressedImage and CameraInfo; decodes pixels on demand."""

import io
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.array_types import Float
from stillmap.core.camera import Camera, Images
from stillmap.core.errors import InputError
from stillmap.io.cameras import open_image, order_images, to_array
from stillmap.io.ros import messages
from stillmap.io.ros.bag import Bag
from stillmap.io.ros.tf import TransformTree
from stillmap.io.trajectory import rigid_transform

_RAW = {  # encoding: type, channels, indices of red, green and blue
    "rgb8": ("u1", 3, (0, 1, 2)),
    "rgba8": ("u1", 4, (0, 1, 2)),
    "bgr8": ("u1", 3, (2, 1, 0)),
    "bgra8": ("u1", 4, (2, 1, 0)),
    "8UC3": ("u1", 3, (2, 1, 0)),
    "mono8": ("u1", 1, None),
    "8UC1": ("u1", 1, None),
    "mono16": ("u2", 1, None),
    "16UC1": ("u2", 1, None),
    "32FC1": ("f4", 1, None),
}
# colors of the first two pixels of the first two rows
_BAYER = {f"bayer_{pattern}8": pattern for pattern in ("rggb", "bggr", "gbrg", "grbg")}

_RECTIFIED = re.compile(r"/image_rect(_color|_mono)?(/compressed)?$")
_NONE = np.empty(0)


class ImageCollector:
    """Collects the headers of images, and the cameras' calibrations."""

    def __init__(self) -> None:
        self._headers: list[tuple[int, int, str]] = []  # stamp, log time, topic
        self._infos: dict[str, Any] = {}  # CameraInfo by topic
        self._frames: dict[str, str] = {}

    def add_message(self, message: messages.Message, content: Any) -> None:
        """Add a message, and what was decoded of it."""
        topic = message.channel.topic
        if message.channel.type == messages.CAMERA_INFO:
            self._infos.setdefault(topic, content)
            return
        self._headers.append((messages.stamp_ns(content.header), message.log_ns, topic))
        self._frames.setdefault(topic, messages.frame_name(content.header.frame_id))

    def build_images(
        self, tree: TransformTree, base: str, reopen: Callable[[], Bag]
    ) -> Images | None:
        """The images of a recording, raw ones where a camera has both; None without any."""
        topics = _select_topics(sorted(self._frames))
        headers = [header for header in self._headers if header[2] in topics]
        if not headers:
            return None
        return order_images(
            np.array([stamp for stamp, _, _ in headers], np.int64),
            np.array([topics.index(topic) for _, _, topic in headers], np.int32),
            [self._camera(topic, tree, base) for topic in topics],
            lambda image: _load_image(reopen(), *headers[image]),
        )

    def _camera(self, topic: str, tree: TransformTree, base: str) -> Camera:
        info = self._infos.get(f"{_camera_name(topic)}/camera_info")
        transforms = tree.lookup(base, self._frames[topic], np.zeros(1, np.int64))
        T = None if transforms is None or transforms.moves else transforms.T[0]
        if info is None:
            return Camera(topic, 0, 0, None, "", _NONE, T)
        camera = Camera(topic, int(info.width), int(info.height), None, "", _NONE, T)
        return _apply_camera_info(camera, info)


def _apply_camera_info(camera: Camera, info: Any) -> Camera:
    """Calibrate a camera of raw images, or of rectified ones, which the topic's name tells."""
    # ROS 1 writes the field names in capitals
    K, D, R, P = (
        np.asarray(getattr(info, name if hasattr(info, name) else name.upper()), float)
        for name in "kdrp"
    )
    if _RECTIFIED.search(camera.name):
        K, D, model = P.reshape(-1)[[0, 1, 2, 4, 5, 6, 8, 9, 10]], _NONE, ""
        camera = replace(camera, T_base_camera=_rectify_pose(camera.T_base_camera, R))
    else:
        model = str(info.distortion_model)
    usable = K.shape == (9,) and np.isfinite(K).all() and K[0] > 0.0
    distortion = D if np.isfinite(D).all() else _NONE
    matrix = K.reshape(3, 3) if usable else None
    return replace(camera, K=matrix, model=model, distortion=distortion)


def _rectify_pose(T: Float | None, R: Float) -> Float | None:
    """Rotate a camera pose (4, 4) by R (9,); unchanged where R is no rotation."""
    try:
        turn = rigid_transform(R, np.zeros(3))
    except ValueError:
        return T
    return None if T is None else T @ se2.inverse(turn)


def _camera_name(topic: str) -> str:
    """`/cam` for `/cam/image_raw` and `/cam/image_raw/compressed`."""
    return topic.removesuffix("/compressed").rpartition("/")[0]


def _select_topics(topics: list[str]) -> list[str]:
    by_camera: dict[str, str] = {}
    for topic in sorted(topics, key=lambda t: (t.endswith("/compressed"), t)):
        by_camera.setdefault(_camera_name(topic), topic)
    return sorted(by_camera.values())


def _load_image(bag: Bag, stamp: int, log_ns: int, topic: str) -> NDArray[Any]:
    try:
        for message in bag.messages({topic}, log_ns):
            content = messages.decode(message)
            if messages.stamp_ns(content.header) == stamp:
                return decode_pixels(content, message.channel.type == messages.COMPRESSED_IMAGE)
    except InputError:
        raise
    except Exception as error:  # any error of a library about damaged bytes
        raise InputError(f"an image on {topic} cannot be decoded: {error}") from error
    finally:
        bag.close()
    raise InputError(f"the image on {topic} at {stamp} ns is no longer there")


def decode_pixels(message: Any, compressed: bool) -> NDArray[Any]:
    """Decode an image: (height, width, 3) uint8 RGB, or (height, width) of one channel.

    Raises:
        InputError: it is damaged, too large, or of an unknown encoding.
    """
    if compressed:
        with open_image(io.BytesIO(bytes(message.data)), "an image") as image:
            return to_array(image)
    height, width, step = int(message.height), int(message.width), int(message.step)
    encoding = str(message.encoding)
    kind, channels, order = _RAW.get(encoding, ("u1", 1, None))
    if encoding not in _RAW and encoding not in _BAYER:
        raise InputError(f"an image is encoded as {encoding!r}, which is not read")
    dtype = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    packed = width * channels * dtype.itemsize
    if step < packed or not height or (height - 1) * step + packed > len(message.data):
        raise InputError("an image is smaller than it states")
    strides = (step, channels * dtype.itemsize, dtype.itemsize)
    values = np.ndarray((height, width, channels), dtype, message.data, strides=strides)
    if encoding in _BAYER:
        return _demosaic(values[..., 0], _BAYER[encoding])
    chosen = values[..., 0] if order is None else values[..., list(order)]
    return np.ascontiguousarray(chosen, dtype.newbyteorder("="))


def _demosaic(values: NDArray[Any], pattern: str) -> NDArray[Any]:
    """RGB from a Bayer mosaic; each square of four pixels gets one color."""
    h, w = (values.shape[0] // 2) * 2, (values.shape[1] // 2) * 2
    quads = values[:h, :w].reshape(h // 2, 2, w // 2, 2).astype(np.uint16)
    parts = {c: np.zeros((h // 2, w // 2), np.uint16) for c in "rgb"}
    for k, color in enumerate(pattern):
        parts[color] += quads[:, k // 2, :, k % 2]
    parts["g"] //= 2
    small = np.stack([parts[c] for c in "rgb"], axis=-1).astype(np.uint8)
    # full size, so that the camera matrix stays valid
    return np.repeat(np.repeat(small, 2, axis=0), 2, axis=1)
