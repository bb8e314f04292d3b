"""A flat laser decides what moves, another one on the same robot builds in 3D (Sect. 4.4, 4.5).

Around what the flat laser saw to move stand boxes, from the ground to where what is connected
ends. What ends in them is taken for dynamic; what the other laser itself saw to stay or to go
counts, too.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap import em
from stillmap.em import dwell
from stillmap.em.chunks import chunks
from stillmap.errors import InputError
from stillmap.objects import MovingObject
from stillmap.pipeline import Options
from stillmap.recording.model import Recording
from stillmap.recording.spacing import spacing
from stillmap.recording.spool import blocks
from stillmap.recording.stamps import beam_ns
from stillmap.result import Result
from stillmap.scene.boxes import Box, boxes_of
from stillmap.scene.ground import Ground, ground_of
from stillmap.scene.riding import Ridden, ridden
from stillmap.scene.rig_options import RigOptions

Float = NDArray[np.float64]
Index = NDArray[np.intp]

_KNEE = 1.0  # m above the ground, below which the flat laser lies: all there is of what it saw
_EDGE = 98.0  # percent of a thing's end points that lie lower than what counts as its top
_FEWEST = 3  # end points of a thing in 3D: fewer are noise
_SURE = 1e-6  # probabilities keep so far from 0 and 1
_DYNAMIC = 0.5


@dataclass(frozen=True, eq=False)
class Tilting:
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
    seen: Recording
    poses: Float
    p_static: NDArray[np.float32]
    objects: list[MovingObject]
    left_out: int
    boxes: int
    learned: dict[str, Any]


class Cut(NamedTuple):
    """What ended in a box.

    Attributes:
        beams: (n,) their numbers, rising.
        core: (n,) whether in the box itself, not in the margin around it.
    """

    beams: Index
    core: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Flat:
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
    def of(cls, result: Result) -> "Flat":
        """What the main job found out about a recording in 2D."""
        seen, p_static = result.seen, result.p_static
        sums = [float(p_static[b][seen.hit[b]].sum(dtype=float)) for b in blocks(p_static)]
        share = sum(sums) / max(sum(int(seen.hit[b].sum()) for b in blocks(seen.hit)), 1)
        return cls(seen, result.poses, p_static, result.objects, share)


def require_rig(flat: Recording, tilting: Recording, where: str) -> None:
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


def built_in_3d(flat: Flat, recording: Recording, options: Options, threads: int = 1) -> Tilting:
    """P(static) of every beam of a laser that another one tells what moves.

    Args:
        flat: what that other one found out.
        recording: 3D, of the same robot by the same clock.
        options: see Options; `rig` above all.
        threads: same result with any number.
    """
    o = options.rig
    on_way = ridden(recording, flat.seen.stamp_ns, flat.poses, o.pause)
    ground = _ground(on_way)
    found = _evidence(on_way, ground, options, threads) if o.evidence else None
    static = _prior(on_way.seen, flat.share) if found is None else found.p_static
    boxes = boxes_of(flat.seen, flat.poses, flat.p_static, flat.objects, options.objects, o.hold)
    cut = _cut(boxes, recording, on_way, ground, int(flat.seen.stamp_ns[0]), o)
    share = flat.share if found is None else _learned_share(found)
    p_static = _within(static, cut, share, o)
    return Tilting(
        recording,
        on_way.seen,
        on_way.poses,
        p_static,
        _objects(flat.objects, boxes, cut, on_way, ground, p_static),
        on_way.left_out,
        sum(len(one.beams) > 0 for one in cut),
        {} if found is None else found.learned,
    )


def evidence_of(
    flat: Flat, recording: Recording, options: Options, threads: int = 1
) -> em.Expectations:
    """What that laser itself says of its beams, from where the flat one knows it was.

    Arguments are those of `built_in_3d`.
    """
    on_way = ridden(recording, flat.seen.stamp_ns, flat.poses, options.rig.pause)
    return _evidence(on_way, _ground(on_way), options, threads)


def _ground(on_way: Ridden) -> Ground:
    """By everything that is level: nobody knows yet what moves."""
    all_static = _prior(on_way.seen, 1.0)
    return ground_of(on_way.seen, on_way.poses, all_static)


def _evidence(on_way: Ridden, ground: Ground, options: Options, threads: int) -> em.Expectations:
    """What the laser itself saw to stay and to go.

    A border between voxels lies just above the floor: feet share none with it.
    """
    voxel = options.rig.voxel or spacing(on_way.seen)
    floor = float(np.median(ground.at(on_way.poses[:, :2, 3])))
    poses = on_way.poses.copy()
    poses[:, 2, 3] -= floor + options.rig.low
    return dwell.e_step(on_way.seen, poses, voxel, options.em, threads)


def _learned_share(found: em.Expectations) -> float:
    """Of what beams ended on, that is static: what is known of a voxel nobody looked at twice."""
    share = found.learned["p_static"]
    if not isinstance(share, float):
        raise RuntimeError("the default estimator learns it")
    return share


def _prior(seen: Recording, share: float) -> NDArray[np.float32]:
    """(M,) the same for all that can be used."""
    out = seen.per_beam(np.float32)
    for block in blocks(out, seen.points):
        out[block] = np.where(np.isnan(seen.points[block]).any(axis=1), np.nan, share)
    return out


def _cut(
    boxes: Sequence[Box],
    recording: Recording,
    on_way: Ridden,
    ground: Ground,
    start_ns: int,
    o: RigOptions,
) -> list[Cut]:
    """Of each box the beams that ended in it or in its margin."""
    ends = _ends(on_way)
    seconds = 1e-9 * (recording.stamp_ns - start_ns)
    early, late = _span(recording)
    out = []
    for box in boxes:
        first = int(np.searchsorted(seconds, box.seconds[0] - box.hold - late))
        stop = int(np.searchsorted(seconds, box.seconds[-1] + box.hold - early, side="right"))
        beams = slice(int(recording.offset[first]), int(recording.offset[stop]))
        if beams.start == beams.stop:
            out.append(Cut(np.zeros(0, np.intp), np.zeros(0, np.bool_)))
            continue
        at = np.asarray(1e-9 * (beam_ns(recording, slice(first, stop)) - start_ns), np.float64)
        near = np.flatnonzero(_near(box, ends[beams], o.margin))
        xyz = np.asarray(ends[beams][near], np.float64)
        within = box.holds(at[near], xyz[:, :2], o.margin)
        near, xyz = near[within], xyz[within]
        core = box.holds(at[near], xyz[:, :2], 0.0)
        above = xyz[:, 2] - ground.at(xyz[:, :2])
        tall = o.tallest if 2.0 * max(box.half) >= o.long else o.height
        kept = (above > o.low) & (above <= top_of(above, tall, o.gap))
        out.append(Cut(beams.start + near[kept], core[kept]))
    return out


def _ends(on_way: Ridden) -> NDArray[np.float32]:
    """(M, 3) where hits ended in the map frame, NaN for others."""
    seen = on_way.seen
    ends = seen.per_beam(np.float32, (3,))
    T_map_sensor = seen.T_map_sensor(on_way.poses)
    for scans, beams, offset in chunks(seen, beside=[ends]):
        T = np.repeat(T_map_sensor[scans], np.diff(offset), axis=0)
        xyz = np.einsum("nij,nj->ni", T[:, :3, :3], seen.points[beams]) + T[:, :3, 3]
        ends[beams] = np.where(seen.hit[beams, None], xyz, np.nan)
    return ends


def _span(recording: Recording) -> tuple[float, float]:
    """Seconds after its scan's stamp of the first beam and of the last, of all scans."""
    times = recording.beam_time
    if times is None or not len(times):
        return 0.0, 0.0
    parts = [(float(times[b].min()), float(times[b].max())) for b in blocks(times)]
    return min(low for low, _ in parts), max(high for _, high in parts)


def _near(box: Box, ends: NDArray[np.float32], margin: float) -> NDArray[np.bool_]:
    """(n,) whether ends lie where the box ever is; cheaper than to ask when."""
    gone = box.hold * float(np.linalg.norm(box.velocity[[0, -1]], axis=1).max())
    reach = float(np.linalg.norm(box.half)) + 2.0 * margin + gone
    low, high = box.xy.min(axis=0) - reach, box.xy.max(axis=0) + reach
    return np.asarray(((ends[:, :2] >= low) & (ends[:, :2] <= high)).all(axis=1))


def top_of(above: Float, tallest: float, gap: float) -> float:
    """Metres above the ground up to where what is connected reaches, from the ground on.

    Args:
        above: (n,) heights of end points above the ground.
        tallest: no thing is higher.
        gap: m without any point, above which something else begins.
    """
    higher = np.sort(above[(above > _KNEE) & (above <= tallest)])
    steps = np.diff(higher, prepend=_KNEE)
    ends = np.flatnonzero(steps > gap)
    reached = higher[: ends[0]] if len(ends) else higher
    return float(reached[-1]) if len(reached) else min(_KNEE, tallest)


def _within(
    static: NDArray[np.float32], cut: Sequence[Cut], share: float, o: RigOptions
) -> NDArray[np.float32]:
    """P(static) with the boxes: in them it is not `share` of all beams that is static.

    The odds are those of the box times what the evidence adds to the odds of `share`; without
    evidence it adds nothing.
    """
    out = static.copy()
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
    cut: Sequence[Cut],
    on_way: Ridden,
    ground: Ground,
    p_static: NDArray[np.float32],
) -> list[MovingObject]:
    """What moved, of which there are points in 3D: with its height and these."""
    by_id = {one.id: one for one in objects}
    out = []
    for box, within in zip(boxes, cut, strict=True):
        beams = within.beams[p_static[within.beams] < _DYNAMIC]
        if box.thing < 0 or len(beams) < _FEWEST:
            continue
        xyz = on_way.seen.end_points(beams, on_way.poses)
        tall = float(np.percentile(xyz[:, 2] - ground.at(xyz[:, :2]), _EDGE))
        one = by_id[box.thing]
        out.append(
            dataclasses.replace(
                one,
                beams=beams,
                z=ground.at(one.xy) + 0.5 * tall,
                size=(*one.size[:2], tall),
                p_dynamic=float(1.0 - p_static[beams].mean(dtype=np.float64)),
            )
        )
    return out
