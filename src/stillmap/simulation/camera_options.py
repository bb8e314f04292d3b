"""The parameters of the cameras that look on beside a lidar, or beside a laser that tilts."""

import math
from dataclasses import dataclass

from stillmap.options import field_with_doc
from stillmap.simulation.options import require

_WIDEST = math.radians(150.0)


@dataclass(frozen=True)
class CameraOptions:
    """Cameras on the robot, all alike; each takes a whole picture at once."""

    enabled: bool = field_with_doc(False, "there are cameras")
    count: int = field_with_doc(1, "how many, spread evenly over the directions; all at once")
    width: int = field_with_doc(640, "pixels")
    height: int = field_with_doc(480, "pixels")
    fov: float = field_with_doc(1.4, "rad, from the left edge of a picture to the right one")
    rate: float = field_with_doc(2.0, "Hz, pictures per second of each camera")
    x: float = field_with_doc(
        0.1, "m, ahead of the base centre; ring: the circle on which they sit"
    )
    y: float = field_with_doc(0.0, "m, to the left of the base centre; likewise")
    z: float = field_with_doc(1.2, "m, above the floor on which the robot stands")
    yaw: float = field_with_doc(0.0, "rad, where the first camera looks, to the left of ahead")
    pitch: float = field_with_doc(0.05, "rad, nose down")
    k1: float = field_with_doc(0.0, "distortion of the lens as OpenCV has it (plumb_bob)")
    k2: float = field_with_doc(0.0, "the same")
    p1: float = field_with_doc(0.0, "the same")
    p2: float = field_with_doc(0.0, "the same")
    noise: float = field_with_doc(2.0, "of 255, standard deviation of each value of a pixel")
    exposure: float = field_with_doc(
        0.0, "relative, standard deviation of how bright pictures are; 0: all alike"
    )
    antialias: int = field_with_doc(1, "rays across and down each pixel")

    def __post_init__(self) -> None:
        require(1 <= self.count <= 16, "count must lie in [1, 16]")
        require(min(self.width, self.height) >= 2, "width and height must be at least 2")
        require(max(self.width, self.height) <= 8192, "width and height must be at most 8192")
        require(0 < self.fov <= _WIDEST, "fov must lie above 0, and be 150 degrees at most")
        require(self.rate > 0, "rate must be positive")
        require(self.z > 0, "z must be positive")
        require(abs(self.pitch) < math.pi / 2, "pitch must lie within 90 degrees")
        require(self.noise >= 0 and self.exposure >= 0, "deviations must not be negative")
        require(1 <= self.antialias <= 4, "antialias must lie in [1, 4]")
        # beyond, a lens bends rays back: several would meet one pixel
        require(max(abs(self.k1), abs(self.k2)) <= 0.4, "k1 and k2 must lie in [-0.4, 0.4]")
        require(max(abs(self.p1), abs(self.p2)) <= 0.05, "p1 and p2 must lie in [-0.05, 0.05]")

    @property
    def distortion(self) -> tuple[float, ...]:
        """The parameters of the lens, none where it is ideal."""
        values = (self.k1, self.k2, self.p1, self.p2)
        return (*values, 0.0) if any(values) else ()
