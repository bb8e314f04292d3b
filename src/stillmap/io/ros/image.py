"""Image, CompressedImage and CameraInfo messages: found while reading, loaded when asked for."""

import io
import re
import warnings
from array import array
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stillmap.core import se2
from stillmap.core.camera import Camera, Images
from stillmap.core.errors import InputError
from stillmap.io.builder import SkippedRecords
from stillmap.io.point_cloud.files import rigid_transform
from stillmap.io.ros.bag_types import Bag, Message
from stillmap.io.ros.messages import CAMERA_INFO, COMPRESSED_IMAGE, decode, frame_name, stamp_ns
from stillmap.io.ros.tf import TransformTree

_MAX_PIXELS = 1 << 27
_RAW = {  # encoding: type, channels, where red, green and blue are
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
# Bayer: which colour the first two pixels of the first two rows have
_BAYER = {
    "bayer_rggb8": "rggb",
    "bayer_bggr8": "bggr",
    "bayer_gbrg8": "gbrg",
    "bayer_grbg8": "grbg",
}


_RECTIFIED = re.compile(r"/image_rect(_color|_mono)?(/compressed)?$")
_NONE = np.empty(0)


class ImageCollector:
    """Where the pictures of a bag are."""

    def __init__(self) -> None:
        self.stamp_ns, self.log_ns = array("q"), array("q")
        self.topic: list[str] = []
        self.infos: dict[str, Any] = {}  # CameraInfo by topic
        self.frames: dict[str, str] = {}
        self.skipped = SkippedRecords()

    def add(self, message: Message) -> None:
        """Take in a message; of pictures only the header is kept."""
        topic = message.channel.topic
        try:
            content = decode(message)
            stamp, name = stamp_ns(content.header), frame_name(content.header.frame_id)
        except Exception:  # whatever the library makes of damaged bytes
            self.skipped.add(f"picture that cannot be decoded ({topic})", len(self.topic) + 1)
            return
        if message.channel.type == CAMERA_INFO:
            self.infos.setdefault(topic, content)
            return
        self.stamp_ns.append(stamp)
        self.log_ns.append(message.log_ns)
        self.topic.append(topic)
        self.frames.setdefault(topic, name)

    def build_images(
        self, transforms: TransformTree, base: str, reopened: Callable[[], Bag]
    ) -> Images | None:
        """The pictures as part of a recording, raw ones where a camera has both."""
        chosen = _select_topics(sorted(self.frames))
        its = [k for k, topic in enumerate(self.topic) if topic in chosen]
        if not its:
            return None
        its.sort(key=lambda k: self.stamp_ns[k])
        cameras = tuple(self._camera(topic, transforms, base) for topic in chosen)

        def load(image: int) -> NDArray[Any]:
            k = its[image]
            return _load_image(reopened(), self.topic[k], self.log_ns[k], self.stamp_ns[k])

        return Images(
            np.array([self.stamp_ns[k] for k in its], np.int64),
            np.array([chosen.index(self.topic[k]) for k in its], np.int32),
            cameras,
            load,
        )

    def _camera(self, topic: str, transforms: TransformTree, base: str) -> Camera:
        info = self.infos.get(f"{_camera_name(topic)}/camera_info")
        placed = transforms.lookup(base, self.frames[topic], np.zeros(1, np.int64))
        T = None if placed is None or placed.moves else placed.T[0]
        if info is None:
            return Camera(topic, 0, 0, None, "", np.empty(0), T)
        return _apply_camera_info(
            Camera(topic, int(info.width), int(info.height), None, "", _NONE, T), info
        )


def _apply_camera_info(camera: Camera, info: Any) -> Camera:
    """The camera with what a CameraInfo says: of raw pictures, or of those made from them that
    are rectified, by the name of their topic."""
    # ROS 1 names the fields with capitals
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
    return replace(
        camera,
        K=K.reshape(3, 3) if usable else None,
        model=model,
        distortion=D if np.isfinite(D).all() else _NONE,
    )


def _rectify_pose(
    T: NDArray[np.float64] | None, R: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """The place of a camera that is turned by R (9,); as it is where R is no rotation."""
    try:
        turn = rigid_transform(R, np.zeros(3))
    except ValueError:
        return T
    return None if T is None else T @ se2.inverse(turn)


def _camera_name(topic: str) -> str:
    """/cam of /cam/image_raw and of /cam/image_raw/compressed."""
    return topic.removesuffix("/compressed").rpartition("/")[0]


def _select_topics(topics: list[str]) -> list[str]:
    by_camera: dict[str, str] = {}
    for topic in sorted(topics, key=lambda t: (t.endswith("/compressed"), t)):
        by_camera.setdefault(_camera_name(topic), topic)
    return sorted(by_camera.values())


def _load_image(bag: Bag, topic: str, log_ns: int, stamp: int) -> NDArray[Any]:
    try:
        for message in bag.messages({topic}, log_ns):
            content = decode(message)
            if stamp_ns(content.header) == stamp:
                return decode_pixels(content, message.channel.type == COMPRESSED_IMAGE)
    except InputError:
        raise
    except Exception as error:  # whatever a library makes of damaged bytes
        raise InputError(f"a picture on {topic} cannot be decoded: {error}") from error
    finally:
        bag.close()
    raise InputError(f"the picture on {topic} at {stamp} ns is no longer there")


def decode_pixels(message: Any, compressed: bool) -> NDArray[Any]:
    """(height, width, 3) uint8 red, green, blue, or (height, width) of one channel.

    Raises:
        InputError: it is damaged, too large, or of an unknown encoding.
    """
    if compressed:
        return _decompress(bytes(message.data))
    height, width, step = int(message.height), int(message.width), int(message.step)
    encoding = str(message.encoding)
    kind, channels, order = _RAW.get(encoding, ("u1", 1, None))
    if encoding not in _RAW and encoding not in _BAYER:
        raise InputError(f"a picture is encoded as {encoding!r}, which is not read")
    dtype = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    packed = width * channels * dtype.itemsize
    if step < packed or not height or (height - 1) * step + packed > len(message.data):
        raise InputError("a picture is smaller than it states")
    strides = (step, channels * dtype.itemsize, dtype.itemsize)
    values = np.ndarray((height, width, channels), dtype, message.data, strides=strides)
    if encoding in _BAYER:
        return _demosaic(values[..., 0], _BAYER[encoding])
    chosen = values[..., 0] if order is None else values[..., list(order)]
    return np.ascontiguousarray(chosen, dtype.newbyteorder("="))


def _decompress(data: bytes) -> NDArray[Any]:
    with warnings.catch_warnings():
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        with Image.open(io.BytesIO(data), formats=("JPEG", "PNG", "WEBP", "TIFF")) as image:
            if image.width * image.height > _MAX_PIXELS:
                raise InputError("a picture is too large")
            whole = image if image.mode in ("L", "I;16", "F") else image.convert("RGB")
            return np.array(whole)


def _demosaic(values: NDArray[Any], pattern: str) -> NDArray[Any]:
    """Colours from a Bayer mosaic: each square of four pixels has one, at half the resolution."""
    h, w = (values.shape[0] // 2) * 2, (values.shape[1] // 2) * 2
    quads = values[:h, :w].reshape(h // 2, 2, w // 2, 2).astype(np.uint16)
    parts = {c: np.zeros((h // 2, w // 2), np.uint16) for c in "rgb"}
    for k, colour in enumerate(pattern):
        parts[colour] += quads[:, k // 2, :, k % 2]
    parts["g"] //= 2
    small = np.stack([parts[c] for c in "rgb"], axis=-1).astype(np.uint8)
    # each pixel of the square gets its colour: the picture keeps its size, and its pinhole matrix
    return np.repeat(np.repeat(small, 2, axis=0), 2, axis=1)
