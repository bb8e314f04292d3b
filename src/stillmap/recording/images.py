"""Pictures that a recording holds beside its scans: where and when they were taken, read one by
one."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Camera:
    """One camera on the robot.

    Attributes:
        name: of its topic or folder.
        width, height: pixels.
        K: (3, 3) float64, pinhole matrix of the pictures as they are recorded; None: unknown.
        model: of the lens, `plumb_bob`, `rational_polynomial`, `equidistant` or "" for none.
        distortion: (n,) float64, its parameters; empty for none.
        T_base_camera: (4, 4) float64, x right, y down, z ahead in the camera; None: unknown.
    """

    name: str
    width: int
    height: int
    K: NDArray[np.float64] | None
    model: str
    distortion: NDArray[np.float64]
    T_base_camera: NDArray[np.float64] | None


@dataclass(frozen=True, eq=False)
class Images:
    """N pictures in the order of their stamps; none is in memory.

    Attributes:
        stamp_ns: (N,) int64, the clock of the scans, non-decreasing.
        camera: (N,) int32, which of `cameras` took each.
        cameras: the cameras.
        load: reads one picture; see `read`.
    """

    stamp_ns: NDArray[np.int64]
    camera: NDArray[np.int32]
    cameras: tuple[Camera, ...]
    load: Callable[[int], NDArray[Any]]

    def __post_init__(self) -> None:
        N = len(self.stamp_ns)
        if self.stamp_ns.dtype != np.int64 or self.camera.dtype != np.int32:
            raise ValueError("images: expected int64 stamps and int32 cameras")
        if self.camera.shape != (N,) or np.any(self.stamp_ns[1:] < self.stamp_ns[:-1]):
            raise ValueError(f"images: expected ({N},) cameras and stamps that do not fall")
        if N and (self.camera.min() < 0 or self.camera.max() >= len(self.cameras)):
            raise ValueError("images: a camera that is not there")

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def read(self, image: int) -> NDArray[Any]:
        """(height, width, 3) uint8 red, green, blue, or (height, width) uint8, uint16 or float32.

        Raises:
            InputError: it is damaged or no longer there.
        """
        return self.load(image)
