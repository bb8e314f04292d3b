"""Labels of a tilting laser's beams from what a planar laser on the same robot tracked.

Sect. 4.4, 4.5 of the paper. Boxes around tracked objects reach from the ground to their tops; what
ends in them is probably dynamic. The tilting laser's own occupancy evidence multiplies the odds.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from stillmap.core.array_types import Float, Float32
from stillmap.core.arrays import copy, iter_blocks
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.em import EmOptions, GroundMap, estimate_ground, occupancy_hmm
from stillmap.em.spatial_coupling import GROUND_CLEARANCE
from stillmap.em.types import DYNAMIC_BELOW, MIN_PROBABILITY
from stillmap.pipeline import tilting_beams
from stillmap.pipeline.tilting_beams import BoxBeams, PosedRecording
from stillmap.tracking import MovingObject
from stillmap.tracking.boxes import Box, fit_boxes
from stillmap.tracking.objects_3d import MIN_POINTS

_VOXEL = 0.1  # m, edge of the voxels of the occupancy evidence
_P_INSIDE, _P_AROUND = 0.99, 0.9  # P(dynamic) of end points in a box and in its margin
_TOP_PERCENTILE = 98.0  # of an object's end points, which gives its height


@dataclass(frozen=True, eq=False)
class TiltingResult(ShortRepr):
    """Labels of the recording that builds in 3D, T scans with M beams.

    Attributes:
        recording: as read.
        deskewed: without motion during its scans; beams without a known pose are unusable.
        poses: (T, 4, 4) T_map_base.
        p_static: (M,) float32, P(c = 1); NaN: unusable.
        objects: moving objects, with height and beams of this recording.
        unposed_beams: number of beams without a known pose.
        boxes: around the objects that the planar laser tracked.
        boxes_hit: number of boxes that hold beams.
        learned: what the occupancy evidence learned, JSON-able; empty without.
        local: the same in a frame near the robot, as of `MappingResult`.
    """

    recording: Recording
    deskewed: Recording
    poses: Float
    p_static: Float32
    objects: list[MovingObject]
    unposed_beams: int
    boxes: list[Box]
    boxes_hit: int
    learned: dict[str, Any]
    local: "TiltingResult | None" = field(default=None, repr=False)

    @property
    def near(self) -> "TiltingResult":
        """The same in a frame near the robot, where coordinates of 32 bits are precise."""
        return self if self.local is None else self.local


@dataclass(frozen=True, eq=False)
class PlanarResult:
    """Result of the planar laser, T scans with M beams.

    Attributes:
        deskewed: 2D, without motion during its scans.
        poses: (T, 3, 3) T_map_base.
        p_static: (M,) float32, P(c = 1).
        objects: moving objects.
    """

    deskewed: Recording
    poses: Float
    p_static: Float32
    objects: Sequence[MovingObject]


def check_rig(planar: Recording, tilting: Recording, where: str) -> None:
    """Checks that two recordings can be of one rig.

    Raises:
        InputError: the second is not 3D or empty, or they do not overlap in time.
    """
    if tilting.dimension != 3:
        raise InputError("is in 2D", where=where, hint="a recording with points in 3D")
    if not tilting.n_scans:
        raise InputError("holds no scan that can be used", where=where)
    first, last = tilting.stamp_ns[[0, -1]]
    if last < planar.stamp_ns[0] or first > planar.stamp_ns[-1]:
        raise InputError("was not recorded at the same time as the other recording", where=where)


def build_tilting(
    planar: PlanarResult,
    recording: Recording,
    em_options: EmOptions,
    threads: int = 1,
    *,
    use_evidence: bool = True,
) -> TiltingResult:
    """P(static) of every beam of a tilting laser.

    Args:
        planar: result of the planar laser.
        recording: 3D, of the same robot by the same clock.
        em_options: of the occupancy evidence.
        threads: the result does not depend on it.
        use_evidence: whether the tilting laser's own occupancy evidence counts.
    """
    posed = tilting_beams.pose_recording(recording, planar.deskewed.stamp_ns, planar.poses)
    # from all level surfaces, as nothing is labelled yet
    ground = estimate_ground(posed.deskewed, posed.poses, _constant_labels(posed.deskewed, 1.0))
    learned: dict[str, Any] = {"p_static": em_options.prior}
    static = _constant_labels(posed.deskewed, em_options.prior)
    if use_evidence:
        # a voxel border is put just above the floor, so that feet share no voxel with it
        poses = posed.poses.copy()
        poses[:, 2, 3] -= float(np.median(ground.height_at(poses[:, :2, 3]))) + GROUND_CLEARANCE
        evidence = occupancy_hmm.e_step(posed.deskewed, poses, _VOXEL, em_options, threads)
        static, learned = evidence.p_static, evidence.learned
    boxes = fit_boxes(planar.deskewed, planar.poses, planar.p_static, planar.objects)
    start_ns = int(planar.deskewed.stamp_ns[0])
    in_boxes = tilting_beams.select_box_beams(boxes, recording, posed, ground, start_ns)
    p_static = apply_boxes(static, in_boxes, learned["p_static"], recording.scratch)
    return TiltingResult(
        recording,
        posed.deskewed,
        posed.poses,
        p_static,
        _extend_objects(planar.objects, boxes, in_boxes, posed, ground, p_static),
        posed.unposed_beams,
        boxes,
        sum(len(one.beams) > 0 for one in in_boxes),
        learned,
    )


def _constant_labels(recording: Recording, p_static: float) -> Float32:
    """(M,) the same P(static) for all usable beams."""
    out = recording.allocate_per_beam(np.float32)
    for block in iter_blocks(out, recording.points):
        unusable = np.isnan(recording.points[block]).any(axis=1)
        out[block] = np.where(unusable, np.nan, p_static)
    return out


def apply_boxes(
    static: Float32, in_boxes: Sequence[BoxBeams], share: float, scratch: Path | None = None
) -> Float32:
    """P(static) with the boxes: the odds of the box times the odds ratio of the evidence.

    Args:
        static: (M,) P(static) without boxes.
        in_boxes: beams of each box.
        share: P(static) without evidence.
        scratch: folder for large arrays.
    """
    out = copy(static, scratch)
    all_beams = np.concatenate([np.zeros(0, np.intp), *(one.beams for one in in_boxes)])
    core = np.concatenate([np.zeros(0, np.bool_), *(one.core for one in in_boxes)])
    beams, of = np.unique(all_beams, return_inverse=True)
    inside = np.where(np.bincount(of[core], minlength=len(beams)) > 0, _P_INSIDE, _P_AROUND)
    p = np.clip(static[beams].astype(np.float64), MIN_PROBABILITY, 1.0 - MIN_PROBABILITY)
    share = float(np.clip(share, MIN_PROBABILITY, 1.0 - MIN_PROBABILITY))
    odds = p / (1.0 - p) * (1.0 - share) / share * (1.0 - inside) / inside
    out[beams] = odds / (1.0 + odds)
    return out


def _extend_objects(
    objects: Sequence[MovingObject],
    boxes: Sequence[Box],
    in_boxes: Sequence[BoxBeams],
    posed: PosedRecording,
    ground: GroundMap,
    p_static: Float32,
) -> list[MovingObject]:
    """The moving objects with points in 3D: with height and beams of the tilting laser."""
    by_id = {one.id: one for one in objects}
    out = []
    for box, within in zip(boxes, in_boxes, strict=True):
        beams = within.beams[p_static[within.beams] < DYNAMIC_BELOW]
        if box.object_id < 0 or len(beams) < MIN_POINTS:
            continue
        xyz = posed.deskewed.end_points(beams, posed.poses)
        above = xyz[:, 2] - ground.height_at(xyz[:, :2])
        height = float(np.percentile(above, _TOP_PERCENTILE))
        one = by_id[box.object_id]
        out.append(
            dataclasses.replace(
                one,
                beams=beams,
                z=ground.height_at(one.xy) + 0.5 * height,
                size=(*one.size[:2], height),
                p_dynamic=float(1.0 - p_static[beams].mean(dtype=np.float64)),
            )
        )
    return out
