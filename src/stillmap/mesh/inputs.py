"""Inputs of the mesh room: a posed and labelled 3D recording, its moving objects, the ground."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from stillmap.core.recording import Recording
from stillmap.core.timestamps import max_scan_duration_ns
from stillmap.em import GroundMap
from stillmap.mesh.range_image import is_row_scanner
from stillmap.mesh.texture.occluders import TrackedBox
from stillmap.mesh.texture.occlusion import LidarReturns
from stillmap.mesh.types import Float, Float32
from stillmap.rig.build import HOLD
from stillmap.rig.removal import MAX_OBJECT_HEIGHT, MIN_VEHICLE_LENGTH
from stillmap.tracking import MovingObject
from stillmap.tracking.boxes import Box, fit_box


@dataclass(frozen=True, eq=False)
class MeshInputs:
    """A 3D recording of T scans and M beams with poses, labels and moving objects.

    Attributes:
        recording: as it was read, with its times and images.
        deskewed: the same, deskewed.
        poses: (T, 4, 4) T_map_base.
        p_static: (M,) P(c = 1).
        objects: moving objects with their beams.
        boxes: boxes along their tracks, and boxes of detections too short for a track.
        start_ns: stamp at which the seconds of these boxes begin.
        ground: ground height.
    """

    recording: Recording
    deskewed: Recording
    poses: Float
    p_static: Float32
    objects: Sequence[MovingObject]
    boxes: Sequence[TrackedBox]
    start_ns: int
    ground: GroundMap

    @cached_property
    def max_scan_ns(self) -> int:
        """Approximate maximum duration of a scan in nanoseconds."""
        return max_scan_duration_ns(self.recording)

    def index_returns(self) -> LidarReturns:
        """The returns, looked up by time."""
        owned = {one.id: one.beams for one in self.objects}
        boxes = [one.box for one in self.boxes if one.box.object_id in owned]
        return LidarReturns(
            self.recording,
            self.deskewed,
            self.deskewed.T_map_sensor(self.poses),
            self.p_static,
            boxes,
            [owned[box.object_id] for box in boxes],
            self.start_ns,
            is_row_scanner(self.deskewed),
        )


def box_objects(objects: Sequence[MovingObject], start_ns: int) -> list[TrackedBox]:
    """Boxes along the tracks of objects of a 3D recording.

    Raises:
        ValueError: an object has no height.
    """
    boxes = []
    for one in objects:
        if one.z is None:
            raise ValueError("objects: expected those of a recording in 3D")
        height = float(one.size[2])
        boxes.append(TrackedBox(fit_box(one, start_ns, HOLD), one.z - 0.5 * height, height))
    return boxes


def extrude_boxes(
    boxes: Sequence[Box], objects: Sequence[MovingObject], ground: GroundMap
) -> list[TrackedBox]:
    """Planar boxes of a flat laser with the heights that a second laser measured.

    Args:
        boxes: planar boxes.
        objects: moving objects with heights, of the second laser.
        ground: ground height below the boxes.
    """
    heights = {one.id: float(one.size[2]) for one in objects}
    out = []
    for box in boxes:
        is_vehicle = 2.0 * max(box.half_size) >= MIN_VEHICLE_LENGTH
        min_height = 0.0 if is_vehicle else MAX_OBJECT_HEIGHT
        height = max(heights.get(box.object_id, 0.0), min_height)
        out.append(TrackedBox(box, ground.height_at(box.xy), height))
    return out
