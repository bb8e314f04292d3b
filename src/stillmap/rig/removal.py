"""What ends in boxes around what moves: from the ground up to where what is connected ends."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import iter_blocks
from stillmap.core.recording import Recording
from stillmap.core.timestamps import beam_stamps_ns
from stillmap.em import GroundMap
from stillmap.rig.options import RigOptions
from stillmap.rig.trajectory import PosedRecording
from stillmap.tracking.boxes import Box

Float = NDArray[np.float64]
Index = NDArray[np.intp]

_WAIST = 1.0  # m; the flat laser lies lower: what stands in a box so far up is what it saw


class BoxBeams(NamedTuple):
    """What ended in a box.

    Attributes:
        beams: (n,) their numbers, rising.
        core: (n,) whether in the box itself, not in the margin around it.
    """

    beams: Index
    core: NDArray[np.bool_]


def select_box_beams(
    boxes: Sequence[Box],
    recording: Recording,
    on_way: PosedRecording,
    ground: GroundMap,
    start_ns: int,
    o: RigOptions,
) -> list[BoxBeams]:
    """Of each box the beams that ended in it or in its margin.

    Args:
        boxes: around what moves; their seconds count from `start_ns`.
        recording: 3D, as it was read.
        on_way: the same at its place.
        ground: how high it is.
        start_ns: a stamp.
        o: see RigOptions.
    """
    ends = _ends(on_way)
    seconds = 1e-9 * (recording.stamp_ns - start_ns)
    early, late = _span(recording)
    out = []
    for box in boxes:
        first = int(np.searchsorted(seconds, box.seconds[0] - box.hold - late))
        stop = int(np.searchsorted(seconds, box.seconds[-1] + box.hold - early, side="right"))
        beams = slice(int(recording.offset[first]), int(recording.offset[stop]))
        if beams.start == beams.stop:
            out.append(BoxBeams(np.zeros(0, np.intp), np.zeros(0, np.bool_)))
            continue
        at = np.asarray(
            1e-9 * (beam_stamps_ns(recording, slice(first, stop)) - start_ns), np.float64
        )
        near = np.flatnonzero(_near(box, ends[beams], o.margin))
        xyz = np.asarray(ends[beams][near], np.float64)
        within = box.contains(at[near], xyz[:, :2], o.margin)
        near, xyz = near[within], xyz[within]
        core = box.contains(at[near], xyz[:, :2], 0.0)
        above = xyz[:, 2] - ground.height_at(xyz[:, :2])
        tall = o.tallest if 2.0 * max(box.half_size) >= o.long else o.height
        kept = (above > o.low) & (above <= object_height(above, tall, o.gap))
        out.append(BoxBeams(beams.start + near[kept], core[kept]))
    return out


def _ends(on_way: PosedRecording) -> NDArray[np.float32]:
    """(M, 3) where hits ended in the map frame, NaN for others."""
    seen = on_way.seen
    ends = seen.allocate_per_beam(np.float32, (3,))
    for block in iter_blocks(ends, seen.hit):
        hits = block.start + np.flatnonzero(seen.hit[block])
        ends[block] = np.nan
        ends[hits] = seen.end_points(hits, on_way.poses)
    return ends


def _span(recording: Recording) -> tuple[float, float]:
    """Seconds after its scan's stamp of the first beam and of the last, of all scans."""
    times = recording.beam_time
    if times is None or not len(times):
        return 0.0, 0.0
    parts = [(float(times[b].min()), float(times[b].max())) for b in iter_blocks(times)]
    return min(low for low, _ in parts), max(high for _, high in parts)


def _near(box: Box, ends: NDArray[np.float32], margin: float) -> NDArray[np.bool_]:
    """(n,) whether ends lie where the box ever is; cheaper than to ask when."""
    gone = box.hold * float(np.linalg.norm(box.velocity[[0, -1]], axis=1).max())
    reach = float(np.linalg.norm(box.half_size)) + 2.0 * margin + gone
    low, high = box.xy.min(axis=0) - reach, box.xy.max(axis=0) + reach
    return np.asarray(((ends[:, :2] >= low) & (ends[:, :2] <= high)).all(axis=1))


def object_height(above: Float, tallest: float, gap: float) -> float:
    """Metres above the ground up to where what is connected reaches, from the ground on.

    Args:
        above: (n,) heights of end points above the ground.
        tallest: no thing is higher.
        gap: m without any point, above which something else begins.
    """
    higher = np.sort(above[(above > _WAIST) & (above <= tallest)])
    steps = np.diff(higher, prepend=_WAIST)
    ends = np.flatnonzero(steps > gap)
    reached = higher[: ends[0]] if len(ends) else higher
    return float(reached[-1]) if len(reached) else min(_WAIST, tallest)
