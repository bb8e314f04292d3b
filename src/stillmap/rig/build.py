"""A flat laser decides what moves, another one on the same robot builds in 3D (Sect. 4.4, 4.5).

Around what the flat laser saw to move stand boxes, from the ground to where what is connected
ends. What ends in them is taken for dynamic; what the other laser itself saw to stay or to go
counts, too.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap import em
from stillmap.core.arrays import copy, iter_blocks
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.em import GroundMap, estimate_ground, occupancy_hmm
from stillmap.pipeline.options import Options
from stillmap.rig.options import RigOptions
from stillmap.rig.removal import BoxBeams, select_box_beams
from stillmap.rig.trajectory import PosedRecording, pose_recording
from stillmap.tracking import MovingObject
from stillmap.tracking.boxes import Box, fit_boxes

Float = NDArray[np.float64]

_EDGE = 98.0  # percent of a thing's end points that lie lower than what counts as its top
_FEWEST = 3  # end points of a thing in 3D: fewer are noise
_SURE = 1e-6  # probabilities keep so far from 0 and 1
_DYNAMIC = 0.5


@dataclass(frozen=True, eq=False)
class TiltingResult:
    """What is known of the recording that builds in 3D, T scans with M beams.

    Attributes:
        recording: as it was read.
        seen: without motion during its scans; beams whose place nobody knows are unusable.
        poses: (T, 4, 4) T_map_base.
        p_static: (M,) float32, P(c = 1); NaN: unusable.
        objects: what moved, with height and beams of this recording.
        left_out: beams that were taken when nobody knows where the robot was.
        boxes: how many cut something out.
        learned: what the evidence in 3D says, JSON-able; empty without.
    """

    recording: Recording
    deskewed: Recording
    poses: Float
    p_static: NDArray[np.float32]
    objects: list[MovingObject]
    unposed_beams: int
    boxes: int
    learned: dict[str, Any]


@dataclass(frozen=True, eq=False)
class PlanarResult:
    """What the flat laser found out, T scans with M beams.

    Attributes:
        seen: 2D, without motion during its scans.
        poses: (T, 3, 3) T_map_base.
        p_static: (M,) float32, P(c = 1).
        objects: what moved.
        share: of its beams that is static.
    """

    seen: Recording
    poses: Float
    p_static: NDArray[np.float32]
    objects: Sequence[MovingObject]
    share: float

    @classmethod
    def from_labels(
        cls,
        deskewed: Recording,
        poses: Float,
        p_static: NDArray[np.float32],
        objects: Sequence[MovingObject],
    ) -> "PlanarResult":
        """The same with the share of static hits computed from the labels."""
        hit = deskewed.hit
        sums = [float(p_static[b][hit[b]].sum(dtype=float)) for b in iter_blocks(p_static)]
        share = sum(sums) / max(sum(int(hit[b].sum()) for b in iter_blocks(hit)), 1)
        return cls(deskewed, poses, p_static, objects, share)


def check_rig(flat: Recording, tilting: Recording, where: str) -> None:
    """Whether two recordings can be of one rig.

    Raises:
        InputError: the second is not in 3D, or they were not taken at the same time.
    """
    if tilting.dimension != 3:
        raise InputError("is in 2D", where=where, hint="a recording with points in 3D")
    if not tilting.n_scans:
        raise InputError("holds no scan that can be used", where=where)
    if tilting.stamp_ns[-1] < flat.stamp_ns[0] or tilting.stamp_ns[0] > flat.stamp_ns[-1]:
        raise InputError("was not recorded at the same time as the other recording", where=where)


def build_tilting(
    flat: PlanarResult, recording: Recording, options: Options, threads: int = 1
) -> TiltingResult:
    """P(static) of every beam of a laser that another one tells what moves.

    Args:
        flat: what that other one found out.
        recording: 3D, of the same robot by the same clock.
        options: see Options; `rig` above all.
        threads: same result with any number.
    """
    o = options.rig
    on_way = pose_recording(recording, flat.seen.stamp_ns, flat.poses, o.pause)
    ground = _ground(on_way)
    found = _evidence(on_way, ground, options, threads) if o.evidence else None
    static = _prior(on_way.seen, flat.share) if found is None else found.p_static
    boxes = fit_boxes(
        flat.seen, flat.poses, flat.p_static, flat.objects, options.objects.min_p_dynamic, o.hold
    )
    cut = select_box_beams(boxes, recording, on_way, ground, int(flat.seen.stamp_ns[0]), o)
    share = flat.share if found is None else _learned_share(found)
    p_static = apply_boxes(static, cut, share, o, recording.scratch)
    return TiltingResult(
        recording,
        on_way.seen,
        on_way.poses,
        p_static,
        _objects(flat.objects, boxes, cut, on_way, ground, p_static),
        on_way.left_out,
        sum(len(one.beams) > 0 for one in cut),
        {} if found is None else found.learned,
    )


def label_by_occupancy(
    flat: PlanarResult, recording: Recording, options: Options, threads: int = 1
) -> em.EStepResult:
    """What that laser itself says of its beams, from where the flat one knows it was.

    Arguments are those of `built_in_3d`.
    """
    on_way = pose_recording(recording, flat.seen.stamp_ns, flat.poses, options.rig.pause)
    return _evidence(on_way, _ground(on_way), options, threads)


def _ground(on_way: PosedRecording) -> GroundMap:
    """By everything that is level: nobody knows yet what moves."""
    all_static = _prior(on_way.seen, 1.0)
    return estimate_ground(on_way.seen, on_way.poses, all_static)


def _evidence(
    on_way: PosedRecording, ground: GroundMap, options: Options, threads: int
) -> em.EStepResult:
    """What the laser itself saw to stay and to go.

    A border between voxels lies just above the floor: feet share none with it.
    """
    floor = float(np.median(ground.height_at(on_way.poses[:, :2, 3])))
    poses = on_way.poses.copy()
    poses[:, 2, 3] -= floor + options.rig.low
    return occupancy_hmm.e_step(on_way.seen, poses, options.rig.voxel, options.em, threads)


def _learned_share(found: em.EStepResult) -> float:
    """Of what beams ended on, that is static: what is known of a voxel nobody looked at twice."""
    share = found.learned["p_static"]
    if not isinstance(share, float):
        raise RuntimeError("the default estimator learns it")
    return share


def _prior(seen: Recording, share: float) -> NDArray[np.float32]:
    """(M,) the same for all that can be used."""
    out = seen.allocate_per_beam(np.float32)
    for block in iter_blocks(out, seen.points):
        out[block] = np.where(np.isnan(seen.points[block]).any(axis=1), np.nan, share)
    return out


def apply_boxes(
    static: NDArray[np.float32],
    cut: Sequence[BoxBeams],
    share: float,
    o: RigOptions,
    scratch: Path | None = None,
) -> NDArray[np.float32]:
    """P(static) with the boxes: in them it is not `share` of all beams that is static.

    The odds are those of the box times what the evidence adds to the odds of `share`; without
    evidence it adds nothing.

    Args:
        static: (M,) P(static) without boxes.
        cut: what ended in them.
        share: what is static of all that nobody looked at twice.
        o: see RigOptions.
        scratch: folder for what is large.
    """
    out = copy(static, scratch)
    all_cut = np.concatenate([np.zeros(0, np.intp), *(one.beams for one in cut)])
    core = np.concatenate([np.zeros(0, np.bool_), *(one.core for one in cut)])
    beams, of = np.unique(all_cut, return_inverse=True)
    inside = np.where(np.bincount(of[core], minlength=len(beams)) > 0, o.inside, o.around)
    p = np.clip(static[beams].astype(np.float64), _SURE, 1.0 - _SURE)
    share = float(np.clip(share, _SURE, 1.0 - _SURE))
    odds = p / (1.0 - p) * (1.0 - share) / share * (1.0 - inside) / inside
    out[beams] = odds / (1.0 + odds)
    return out


def _objects(
    objects: Sequence[MovingObject],
    boxes: Sequence[Box],
    cut: Sequence[BoxBeams],
    on_way: PosedRecording,
    ground: GroundMap,
    p_static: NDArray[np.float32],
) -> list[MovingObject]:
    """What moved, of which there are points in 3D: with its height and these."""
    by_id = {one.id: one for one in objects}
    out = []
    for box, within in zip(boxes, cut, strict=True):
        beams = within.beams[p_static[within.beams] < _DYNAMIC]
        if box.object_id < 0 or len(beams) < _FEWEST:
            continue
        xyz = on_way.seen.end_points(beams, on_way.poses)
        tall = float(np.percentile(xyz[:, 2] - ground.height_at(xyz[:, :2]), _EDGE))
        one = by_id[box.object_id]
        out.append(
            dataclasses.replace(
                one,
                beams=beams,
                z=ground.height_at(one.xy) + 0.5 * tall,
                size=(*one.size[:2], tall),
                p_dynamic=float(1.0 - p_static[beams].mean(dtype=np.float64)),
            )
        )
    return out
