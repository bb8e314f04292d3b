"""Recordings in chunks of scans, so that memory does not grow with their length."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.recording import Recording

CHUNK_BEAMS = 1 << 20
_MAX_GROWTH = 8  # times CHUNK_BEAMS that a chunk may grow to, to hold `min_groups` groups


class Chunk(NamedTuple):
    """Consecutive scans.

    Attributes:
        scans: slice of the scans.
        beams: slice of their beams.
        offset: (n + 1,) where the beams of each scan begin within these.
    """

    scans: slice
    beams: slice
    offset: NDArray[np.int64]


class ScanBeams(NamedTuple):
    """Beams of n scans, as the kernels take them.

    Attributes:
        points: (m, D) float32 end points in the sensor frame.
        hit: (m,) bool.
        offset: (n + 1,) where the beams of each scan begin.
        T_map_sensor: (n, D+1, D+1).
    """

    points: NDArray[np.float32]
    hit: NDArray[np.bool_]
    offset: NDArray[np.int64]
    T_map_sensor: NDArray[np.float64]


def iter_beams(
    recording: Recording,
    poses: NDArray[np.float64],
    group: NDArray[np.int64] | None = None,
    *,
    min_groups: int = 1,
    release: Sequence[NDArray[Any]] = (),
) -> Iterator[tuple[slice, slice, ScanBeams]]:
    """Yields the scans, the beams, and the data of each chunk; see `iter_chunks`.

    poses: (T, D+1, D+1) T_map_base.
    """
    T_map_sensor = recording.T_map_sensor(poses)
    for scans, beams, offset in iter_chunks(
        recording, group, min_groups=min_groups, release=release
    ):
        points, hit = recording.points[beams], recording.hit[beams]
        yield scans, beams, ScanBeams(points, hit, offset, T_map_sensor[scans])


def iter_chunks(
    recording: Recording,
    group: NDArray[np.int64] | None = None,
    *,
    min_groups: int = 1,
    release: Sequence[NDArray[Any]] = (),
) -> Iterator[Chunk]:
    """Yields chunks of about CHUNK_BEAMS beams.

    Args:
        recording: T scans.
        group: (T,) rising; scans of one group stay in one chunk.
        min_groups: groups per chunk, for threads to share, up to `_MAX_GROWTH` times the beams.
        release: memory-mapped arrays whose pages are released after each chunk, as those of the
            recording are.
    """
    offset, first = recording.offset, 0
    while first < recording.n_scans:
        end = int(np.searchsorted(offset, offset[first] + CHUNK_BEAMS, side="right")) - 1
        end = min(max(end, first + 1), recording.n_scans)
        if group is not None and end < recording.n_scans:
            start = int(np.searchsorted(group, group[end]))  # of the group that would be cut
            end = max(start, _end_of_groups(group, offset, first, max(min_groups, 1)))
        beams = slice(int(offset[first]), int(offset[end]))
        within = np.ascontiguousarray(offset[first : end + 1] - offset[first])
        yield Chunk(slice(first, end), beams, within)
        recording.release_pages(*release)
        first = end


def _end_of_groups(
    group: NDArray[np.int64], offset: NDArray[np.int64], first: int, n_groups: int
) -> int:
    """The first scan after so many groups from `first` on; after fewer if they have many beams."""
    max_offset = offset[first] + _MAX_GROWTH * CHUNK_BEAMS
    for _ in range(n_groups):
        if first < len(group) and offset[first] < max_offset:
            first = int(np.searchsorted(group, group[first], side="right"))
    return first
