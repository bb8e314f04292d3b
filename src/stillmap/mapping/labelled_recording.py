"""Recordings with labels: cells, counts and samples of their beams.

All go block by block: recordings may be larger than memory.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from stillmap import em
from stillmap.core import arrays
from stillmap.core.array_types import Bool, Cells, Float, Float32, Index, Int32
from stillmap.core.arrays import iter_blocks
from stillmap.core.chunks import iter_beams
from stillmap.core.recording import Recording
from stillmap.em.types import DYNAMIC_BELOW


class LabelledRecording(NamedTuple):
    """A recording at known poses, P(static) of its beams, and the cells in which they are counted.

    Attributes:
        recording: T scans with M beams, deskewed.
        poses: (T, D+1, D+1) T_map_base.
        p_static: (M,) P(c = 1); NaN: unusable.
        resolution: m, edge of a cell.
        threads: number of threads; no result depends on it.
    """

    recording: Recording
    poses: Float
    p_static: Float32
    resolution: float
    threads: int = 1

    def copy_labels(self) -> Float32:
        """(M,) labels to be changed, memory-mapped where they are large."""
        return arrays.copy(self.p_static, self.recording.scratch)

    def end_cells(self, beams: Index) -> Cells:
        """(n, D) cells in which ascending beams (n,) ended."""
        ends = self.recording.end_points(beams, self.poses)
        return np.floor(ends / self.resolution).astype(np.int64)

    def iter_hits(self, dynamic: bool | None = None) -> Iterator[Index]:
        """See the function."""
        return iter_hits(self.recording.hit, self.p_static, dynamic)

    def iter_surfels(
        self, histories: em.CellHistories, *release: Float32
    ) -> Iterator[tuple[slice, Int32]]:
        """Beams, and the surfel (n,) in which each ended, -1: none, chunk by chunk.

        Args:
            histories: with the surfels.
            release: memory-mapped arrays whose pages are released after each chunk.
        """
        for _, beams, data in iter_beams(self.recording, self.poses, release=release):
            yield beams, histories.surfel_map.associate_beams(*data, self.threads)


def iter_hits(hit: Bool, p_static: Float32, dynamic: bool | None = None) -> Iterator[Index]:
    """The beams (n,) that hit something, block by block.

    Args:
        hit: (M,) whether a beam ended on something.
        p_static: (M,).
        dynamic: only those with p_static < 0.5, or only the others; None: all.
    """
    for block in iter_blocks(hit, p_static):
        chosen = hit[block]
        if dynamic is not None:
            chosen = chosen & ((p_static[block] < DYNAMIC_BELOW) == dynamic)
        yield block.start + np.flatnonzero(chosen)


def count_beams(hit: Bool, p_static: Float32) -> dict[str, int]:
    """`beams`, `hits`, `max_range`, `unusable` and `dynamic` (hits with p_static < 0.5) of M beams.

    Args:
        hit: (M,) whether a beam ended on something.
        p_static: (M,); NaN: unusable.
    """
    hits = dynamic = unusable = 0
    for block in iter_blocks(hit, p_static):
        hits += int(np.count_nonzero(hit[block]))
        dynamic += int(np.count_nonzero(hit[block] & (p_static[block] < DYNAMIC_BELOW)))
        unusable += int(np.count_nonzero(np.isnan(p_static[block])))
    return {
        "beams": len(hit),
        "hits": hits,
        "max_range": len(hit) - hits - unusable,
        "unusable": unusable,
        "dynamic": dynamic,
    }


def sample_points(
    recording: Recording,
    poses: Float,
    p_static: Float32,
    limit: int = 200_000,
    dynamic: bool = True,
) -> Float:
    """Sample the end points, in the map frame, of the hits that are dynamic, or of the others.

    Args:
        recording: T scans with M beams in D dimensions.
        poses: (T, D+1, D+1) T_map_base.
        p_static: (M,); below 0.5 a hit is dynamic.
        limit: maximum number of points; of more, evenly spaced ones are taken.
        dynamic: whether dynamic or static hits.

    Returns:
        (K, D) metres, in the recording's order, K <= limit.
    """
    counts = [len(hits) for hits in iter_hits(recording.hit, p_static, dynamic)]
    total = sum(counts)
    kept = min(total, limit)
    chosen = np.arange(kept, dtype=np.int64) * total // max(kept, 1)
    before = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
    parts = [np.zeros(0, np.int64)]
    every = iter_hits(recording.hit, p_static, dynamic)
    for hits, start, end in zip(every, before[:-1], before[1:], strict=True):
        low, high = np.searchsorted(chosen, [start, end])
        parts.append(hits[chosen[low:high] - start])
    return recording.end_points(np.concatenate(parts), poses)
