"""Scans of a result as ROS messages: static and dynamic LaserScans, or PointCloud2 with labels."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.em.types import DYNAMIC_BELOW
from stillmap.io.ros import writer as ros
from stillmap.io.ros.messages import LASER_SCAN, POINT_CLOUD
from stillmap.io.ros.writer import BagWriter, LaserScanEncoder, Send, number_names
from stillmap.results.folder import Exported
from stillmap.results.point_cloud import Block
from stillmap.results.points import FIELDS, PACKED_COLOUR, make_vertices


class LaserWriter:
    """Writes each scan of a 2D result to a static and a dynamic topic of its laser.

    Attributes:
        arrays: per-beam arrays that are read.

    Raises:
        InputError: the beam directions of a scan are not evenly spaced.
    """

    def __init__(self, result: Exported) -> None:
        self._recording, self._p_static = result.recording, result.p_static
        self._encoder = LaserScanEncoder(result.recording)
        self.arrays: tuple[NDArray[Any], ...] = (result.p_static,)

    def open(self, bag: BagWriter, frames: Sequence[str]) -> None:
        """Add the topics of the lasers with these frames."""
        self._bag, self._frames = bag, frames
        names = [f"/{name}" for name in number_names("scan", len(frames))]
        self._static = [bag.add_topic(name, LASER_SCAN) for name in names]
        self._dynamic = [bag.add_topic(f"{name}_dynamic", LASER_SCAN) for name in names]

    def write(self, t: int) -> None:
        """Write scan t; in each message the beams of the other one are NaN."""
        recording = self._recording
        s, stamp = int(recording.sensor[t]), int(recording.stamp_ns[t])
        beams, ranges = recording.beams_of(t), self._encoder.ranges(t)
        is_dynamic = recording.hit[beams] & (self._p_static[beams] < DYNAMIC_BELOW)
        for sends, selected in ((self._static, ~is_dynamic), (self._dynamic, is_dynamic)):
            part = np.where(selected, ranges, np.float32(np.nan))
            message = self._encoder.make_message(self._bag, t, self._frames[s], part)
            sends[s](stamp, message)

    def describe_losses(self) -> list[str]:
        """Properties of a recording that LaserScan cannot represent, a sentence each."""
        return self._encoder.describe_losses()


class LidarWriter:
    """Writes the returns of each sweep of a 3D result to the topic of its lidar.

    Attributes:
        arrays: per-beam arrays that are read.
        deskewed: the recording without the motion during its sweeps.
    """

    def __init__(self, result: Exported) -> None:
        self.deskewed = result.deskew()
        self._p_static, self._colors = result.p_static, result.colors
        read = (self.deskewed.points, result.p_static, result.colors)
        self.arrays: tuple[NDArray[Any], ...] = tuple(one for one in read if one is not None)

    def open(self, bag: BagWriter, frames: Sequence[str]) -> None:
        """Add the topics of the lidars with these frames."""
        self._bag, self._frames = bag, frames
        names = number_names("points", len(frames))
        self._sends: list[Send] = [bag.add_topic(f"/{name}", POINT_CLOUD) for name in names]

    def write(self, t: int) -> None:
        """Write sweep t in the frame of its lidar at the stamp: x, y, z, `p_static`, `rgb`."""
        seen, beams = self.deskewed, self.deskewed.beams_of(t)
        hit, s, stamp = seen.hit[beams], int(seen.sensor[t]), int(seen.stamp_ns[t])
        colors = None if self._colors is None else self._colors[beams][hit]
        points = seen.points[beams][hit].astype(np.float64)
        block = Block(points, self._p_static[beams][hit], None, colors)
        self._sends[s](stamp, make_cloud_message(self._bag, stamp, self._frames[s], block))

    def describe_losses(self) -> list[str]:
        """Properties of a recording that PointCloud2 cannot represent, a sentence each."""
        return []


def make_cloud_message(bag: BagWriter, stamp_ns: int, frame: str, block: Block) -> Any:
    """A PointCloud2 of points in a frame: x, y, z, `p_static`, and `rgb` for colours."""
    fields = FIELDS if block.colors is None else FIELDS + PACKED_COLOUR
    return ros.make_point_cloud(bag, stamp_ns, frame, make_vertices(block, fields))
