"""Joins the camera images of the parts of one run."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.camera import Camera, Images


def join_images(parts: list[Images]) -> Images | None:
    """The images of all parts, in order of stamps and without repeated ones; None: no images."""
    if not parts:
        return None
    cameras: list[Camera] = []
    rows: list[tuple[int, int, int, int]] = []  # stamp, camera, part, image
    seen = set[tuple[int, int]]()
    for number, images in enumerate(parts):
        numbers = [_number_camera(camera, cameras) for camera in images.cameras]
        for image in range(len(images)):
            key = int(images.stamp_ns[image]), numbers[images.camera[image]]
            if key not in seen:
                rows.append((*key, number, image))
        seen.update(row[:2] for row in rows)
    rows.sort(key=lambda row: row[0])

    def load(row: int) -> NDArray[Any]:
        return parts[rows[row][2]].load(rows[row][3])

    return Images(
        np.array([row[0] for row in rows], np.int64),
        np.array([row[1] for row in rows], np.int32),
        tuple(cameras),
        load,
    )


def _number_camera(camera: Camera, known: list[Camera]) -> int:
    """The number of an equal camera; a new one is added."""
    for number, one in enumerate(known):
        if all(_is_same(value, getattr(one, name)) for name, value in vars(camera).items()):
            return number
    known.append(camera)
    return len(known) - 1


def _is_same(a: Any, b: Any) -> bool:
    if a is None or b is None or not isinstance(a, np.ndarray):
        return bool(a is b or a == b)
    return np.array_equal(a, b)
