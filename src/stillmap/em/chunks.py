"""Recordings piece by piece: what one kernel call sees is bounded, whatever the length."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.recording.model import Recording

CHUNK_BEAMS = 1 << 20
_WIDEST = 8  # chunks that one may be as large as, for threads to share it out


class Chunk(NamedTuple):
    """Some scans in a row.

    Attributes:
        scans: which ones.
        beams: their beams.
        offset: (n + 1,) where each scan's beams begin within these.
    """

    scans: slice
    beams: slice
    offset: NDArray[np.int64]


def chunks(
    recording: Recording,
    group: NDArray[np.int64] | None = None,
    *,
    groups: int = 1,
    beside: Sequence[NDArray[Any]] = (),
) -> Iterator[Chunk]:
    """Chunks of about CHUNK_BEAMS beams; scans of equal `group` (T,), rising, stay together.

    At least so many `groups` are in a chunk, where there are as many, and as long as it has fewer
    than _WIDEST times that many beams: threads share these out. What of the recording, and of
    arrays `beside` it, lies in files is let go after each chunk.
    """
    offset, first = recording.offset, 0
    while first < recording.n_scans:
        end = int(np.searchsorted(offset, offset[first] + CHUNK_BEAMS, side="right")) - 1
        end = min(max(end, first + 1), recording.n_scans)
        if group is not None and end < recording.n_scans:
            start = int(np.searchsorted(group, group[end]))  # of the group that would be cut
            end = max(start, _after(group, offset, first, max(groups, 1)))
        beams = slice(int(offset[first]), int(offset[end]))
        within = np.ascontiguousarray(offset[first : end + 1] - offset[first])
        yield Chunk(slice(first, end), beams, within)
        recording.let_go(*beside)
        first = end


def _after(group: NDArray[np.int64], offset: NDArray[np.int64], first: int, groups: int) -> int:
    """The first scan after so many groups, or after fewer that have many beams, or after all."""
    most = offset[first] + _WIDEST * CHUNK_BEAMS
    for _ in range(groups):
        if first < len(group) and offset[first] < most:
            first = int(np.searchsorted(group, group[first], side="right"))
    return first
