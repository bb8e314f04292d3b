"""What models are made of: beams in space, what moves among them, and pictures."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from stillmap.core.parallel import resolve_threads
from stillmap.core.recording import Recording
from stillmap.core.timestamps import max_scan_duration_ns
from stillmap.em import GroundMap, estimate_ground
from stillmap.mesh.options import SurfaceOptions
from stillmap.mesh.range_image import find_scan_layout
from stillmap.mesh.texture.occluders import TrackedBox
from stillmap.mesh.texture.occlusion import LidarReturns
from stillmap.pipeline.options import Options
from stillmap.pipeline.result import Result
from stillmap.rig.build import TiltingResult
from stillmap.tracking import MovingObject
from stillmap.tracking.boxes import Box, fit_box, fit_boxes

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class MeshInputs:
    """A recording in 3D, T scans with M beams, of which everything is known.

    Attributes:
        recording: as it was read; its times and pictures count.
        seen: without the motion during its scans.
        poses: (T, 4, 4) T_map_base.
        p_static: (M,) P(c = 1).
        objects: what moved, with the beams that ended on it.
        things: the same as boxes, and what moved too shortly to be followed.
        start_ns: when the time of these boxes begins.
        ground: how high it is.
    """

    recording: Recording
    seen: Recording
    poses: Float
    p_static: NDArray[np.float32]
    objects: list[MovingObject]
    things: list[TrackedBox]
    start_ns: int
    ground: GroundMap

    @cached_property
    def longest_scan_ns(self) -> int:
        """Nanoseconds that a scan takes at most, about."""
        return max_scan_duration_ns(self.recording)

    def beams(self) -> LidarReturns:
        """To be asked for by time."""
        owned = {one.id: one.beams for one in self.objects}
        boxes = [one.box for one in self.things if one.box.object_id in owned]
        return LidarReturns(
            self.recording,
            self.seen,
            self.seen.T_map_sensor(self.poses),
            self.p_static,
            boxes,
            [owned[box.object_id] for box in boxes],
            self.start_ns,
            find_scan_layout(self.seen, np.zeros(0, np.intp), SurfaceOptions()).planar,
        )


def sources_of(result: Result) -> MeshInputs:
    """Of a recording in 3D."""
    options, seen = result.options, result.seen
    start = int(seen.stamp_ns[0])
    hold = options.mesh.choice.hold
    things = []
    for one in result.objects:
        if one.z is None:
            raise ValueError("objects: expected those of a recording in 3D")
        tall = float(one.size[2])
        things.append(TrackedBox(fit_box(one, start, hold), one.z - 0.5 * tall, tall))
    threads = resolve_threads(options.threads)
    ground = estimate_ground(seen, result.poses, result.p_static, threads)
    return MeshInputs(
        result.recording,
        seen,
        result.poses,
        result.p_static,
        list(result.objects),
        things,
        start,
        ground,
    )


def sources_of_rig(result: Result, tilting: TiltingResult) -> MeshInputs:
    """Of a laser that builds in 3D while another one, that lies flat, tells what moves."""
    options, flat = result.options, result.seen
    start = int(flat.stamp_ns[0])
    threads = resolve_threads(options.threads)
    ground = estimate_ground(tilting.deskewed, tilting.poses, tilting.p_static, threads)
    boxes = fit_boxes(
        flat, result.poses, result.p_static, result.objects, options.objects, options.rig.hold
    )
    tall = {one.id: float(one.size[2]) for one in tilting.objects}
    things = [_upright(box, tall.get(box.object_id, 0.0), ground, options) for box in boxes]
    return MeshInputs(
        tilting.recording,
        tilting.deskewed,
        tilting.poses,
        tilting.p_static,
        tilting.objects,
        things,
        start,
        ground,
    )


def _upright(box: Box, tall: float, ground: GroundMap, options: Options) -> TrackedBox:
    """As high as it was seen to be, and as things of its kind are at least."""
    o = options.rig
    usual = o.height if 2.0 * max(box.half_size) < o.long else 0.0
    return TrackedBox(box, ground.at(box.xy), max(tall, usual))
