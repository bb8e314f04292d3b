"""Beams that are too long for a map: each takes time and memory in proportion to the cells that it
crosses, and few of them lie close enough together to show a surface.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays
from stillmap.core.advice import advise
from stillmap.core.recording import Recording
from stillmap.prepare.options import MAX_PLAUSIBLE_RANGE

# m, and cells, by dimension: a beam is followed up to the greater of both. Planar lasers of robots
# reach 80 m, lidars 300 m; 2000 cells in all directions take half a gigabyte in 2D
_LEAST_REACH = {2: 100.0, 3: MAX_PLAUSIBLE_RANGE}
_REACH_CELLS = {2: 2000, 3: 8000}


def mapped_range(dimension: int, resolution: float, max_range: float | None = None) -> float:
    """Range in metres up to which beams are mapped.

    Args:
        dimension: 2 or 3.
        resolution: m, edge of a cell.
        max_range: m, that the user or the recording states of the sensor; None: not stated.
    """
    reach = max(_LEAST_REACH[dimension], _REACH_CELLS[dimension] * resolution)
    return reach if max_range is None else max(reach, max_range)


def leave_out_far_returns(
    recording: Recording, resolution: float, max_range: float | None = None
) -> tuple[Recording, list[str]]:
    """The recording with beams up to the mapped range alone, and a sentence about the others.

    Returns from farther away are not used. Beams without a return are shortened to the longest
    return that is left: they were as long because of the others. Where all beams are near, the
    recording itself.

    Args:
        recording: M beams.
        resolution, max_range: as of `mapped_range`.
    """
    reach = mapped_range(recording.dimension, resolution, max_range)
    far = _find_far(recording, reach)
    if not len(far):
        return recording, []
    points = arrays.copy(recording.points, recording.scratch)
    hit = arrays.copy(recording.hit, recording.scratch)
    returns, free = far[recording.hit[far]], far[~recording.hit[far]]
    points[returns], hit[returns] = np.nan, False
    kept = replace(recording, points=points, hit=hit)
    if len(free):
        limit = _longest_return(kept) or reach
        length = np.linalg.norm(points[free].astype(np.float64), axis=1, keepdims=True)
        with np.errstate(invalid="ignore"):  # infinite ones become NaN
            points[free] = (points[free] * (limit / length)).astype(np.float32)
    return kept, [_sentence(recording, len(returns), len(free), reach)]


def shorten_far_beams(
    points: NDArray[np.float32], hit: NDArray[np.bool_], reach: float
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """The beams of one scan up to a range: returns beyond it show nothing, other beams end there.

    Args:
        points: (N, D) end points in the sensor frame, m.
        hit: (N,) beams with a return.
        reach: m.
    """
    length = np.linalg.norm(points.astype(np.float64), axis=1)
    far = length > reach
    if not far.any():
        return points, hit
    scale = np.where(far & ~hit, reach / np.where(far, length, 1.0), np.where(far, np.nan, 1.0))
    return (points * scale[:, None]).astype(np.float32), hit & ~far


def _find_far(recording: Recording, reach: float) -> NDArray[np.intp]:
    """Beams longer than `reach` m."""
    found = [np.zeros(0, np.intp)]
    for block in arrays.iter_blocks(recording.points):
        squared = arrays.squared_lengths(recording.points[block])
        found.append(np.flatnonzero(squared > reach * reach) + block.start)
    return np.concatenate(found)


def _longest_return(recording: Recording) -> float:
    """Length of the longest return, m; 0: there is none."""
    longest = 0.0
    for block in arrays.iter_blocks(recording.points, recording.hit):
        squared = arrays.squared_lengths(recording.points[block])
        longest = max(longest, float(squared[recording.hit[block]].max(initial=0.0)))
    return math.sqrt(longest)


def _sentence(recording: Recording, returns: int, free: int, reach: float) -> str:
    if not returns:
        return (
            f"{free} beam{'s' * (free > 1)} without a return would show free space beyond "
            f"{reach:.4g} m, where nothing is mapped: shortened"
        )
    cells = "slam.resolution" if recording.dimension == 2 else "slam.voxel_size"
    option = "read.max_range" if reach < MAX_PLAUSIBLE_RANGE else f"a coarser {cells}"
    total = int(np.count_nonzero(recording.hit))
    return advise(
        f"{returns} of {total} returns are farther than {reach:.4g} m: they are not used",
        f"if the sensor reaches that far, say so by {option}",
    )
