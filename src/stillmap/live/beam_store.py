"""The beams of all scans in temporary files, with a bound on what they take."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from stillmap.core.arrays import ArrayBuilder, empty, iter_blocks, release_pages

Array = NDArray[Any]

_IN_MEMORY = 1 << 18  # bytes of each array that are not yet in its file
_SEGMENTS = 16  # into which the bound is divided
_MIN_SCANS = 16  # of a segment: of few ones hardly any could be dropped
# steps between two scans, and scans and beams that a step copies: about 1 ms, in 3D 5 ms
_STEPS, _SCANS_PER_STEP, _BEAMS_PER_STEP = 4, 16, 20_000


class BeamStore:
    """Beams of scans, appended. Where they take more than the bound, every second one of the scans
    that lie most densely is dropped, the oldest first; a part of that work is done with each scan.

    Args:
        fields: dtype and shape of a row of each array.
        folder: of the temporary files; None: the system's.
        max_bytes: of all arrays, about; None: unbounded.
    """

    def __init__(
        self,
        fields: Sequence[tuple[DTypeLike, tuple[int, ...]]],
        folder: Path | None,
        max_bytes: int | None,
    ) -> None:
        self._fields, self._folder, self._max_bytes = fields, folder, max_bytes
        self._segments = [self._make_segment()]
        self._work: Iterator[None] = iter(())

    def append(self, number: int, rows: list[Array]) -> None:
        """Append the beams of a scan.

        Args:
            number: of the scan; they rise.
            rows: (N, *row) of each array.

        Raises:
            OSError: the disk is full.
        """
        self._segments[-1].append(np.array([number]), np.array([len(rows[0])]), rows)
        if self._max_bytes is None:
            return
        if self._segments[-1].is_full(self._max_bytes / _SEGMENTS):
            self._segments.append(self._make_segment())
        for _ in range(_STEPS):
            is_idle = next(self._work, self) is self
            if is_idle and sum(s.byte_count for s in self._segments) > self._max_bytes:
                self._work = self._thin(self._max_bytes / _SEGMENTS)

    @property
    def kept(self) -> NDArray[np.int64]:
        """(K,) numbers of the scans that are kept, ascending."""
        self._finish()
        return np.concatenate([segment.numbers.view() for segment in self._segments])

    @property
    def counts(self) -> NDArray[np.int64]:
        """(K,) number of beams of these scans."""
        self._finish()
        return np.concatenate([segment.counts.view() for segment in self._segments])

    def parts(self) -> list[list[Array]]:
        """The arrays of the scans that are kept, in parts for `join_parts`; more scans may be
        appended."""
        self._finish()
        return [[array.view() for array in segment.arrays] for segment in self._segments]

    def close(self) -> None:
        """Remove the files."""
        for segment in self._segments:
            segment.close()

    def _finish(self) -> None:
        """Finish what was begun: until then some scans are there twice."""
        for _ in self._work:
            pass

    def _make_segment(self) -> "_Segment":
        return _Segment([ArrayBuilder(t, row, self._folder, _IN_MEMORY) for t, row in self._fields])

    def _thin(self, most: float) -> Iterator[None]:
        """Drop every second scan of the densest segment, the oldest of those; it joins the one
        before if that is as dense then and has room, in segments of at most so many bytes."""
        newest = 1 if len(self._segments[-1].numbers) else 2  # with the last scan, which stays
        halvings = [segment.halvings for segment in self._segments[:-newest]]
        if not halvings:
            return
        at = halvings.index(min(halvings))
        old, thinned = self._segments[at], self._make_segment()
        thinned.halvings = old.halvings + 1
        before = self._segments[at - 1] if at else None
        if (
            before is not None
            and before.halvings == thinned.halvings
            and before.has_room(old, most)
        ):
            thinned = before
        yield from _copy_every_second(old, thinned)
        self._segments[at : at + 1] = [] if thinned is before else [thinned]
        old.close()


class _Segment:
    """Scans one after another, of which every second one was dropped `halvings` times."""

    def __init__(self, arrays: list[ArrayBuilder]) -> None:
        self.arrays = arrays
        self.numbers, self.counts = (ArrayBuilder(np.int64, in_memory=_IN_MEMORY) for _ in range(2))
        self.byte_count, self.halvings = 0, 0

    def append(self, numbers: Array, counts: Array, rows: list[Array]) -> None:
        self.numbers.append(numbers)
        self.counts.append(counts)
        self.byte_count += sum(a.nbytes for a in rows)
        for array, more in zip(self.arrays, rows, strict=True):
            if len(more):
                array.append(more)

    def is_full(self, most: float) -> bool:
        """True if the segment holds more than `most` bytes, in several scans."""
        return self.byte_count > most and len(self.numbers) >= _MIN_SCANS

    def has_room(self, other: "_Segment", most: float) -> bool:
        """True if half of the bytes of another segment fit in, too."""
        fits = self.byte_count + 0.5 * other.byte_count <= 1.1 * most
        return fits or len(self.numbers) < _MIN_SCANS

    def close(self) -> None:
        for array in (*self.arrays, self.numbers, self.counts):
            array.close()


def _copy_every_second(source: _Segment, to: _Segment) -> Iterator[None]:
    """Append every second scan of a segment to another one, some at a time."""
    arrays = [array.view() for array in source.arrays]
    numbers, counts = source.numbers.view(), source.counts.view()
    end = np.cumsum(counts)
    step = int(np.clip(_BEAMS_PER_STEP * len(counts) // max(end[-1], 1), 1, _SCANS_PER_STEP))
    for first in range(0, len(numbers), step):
        scans = slice(first, first + step)
        beams = slice(int(end[first] - counts[first]), int(end[scans][-1]))
        kept = (np.arange(len(numbers[scans])) + first) % 2 == 0
        of_kept = np.repeat(kept, counts[scans])
        to.append(numbers[scans][kept], counts[scans][kept], [a[beams][of_kept] for a in arrays])
        for array in arrays:
            release_pages(array)
        yield


def join_parts(parts: list[list[Array]], folder: Path | None) -> list[Array]:
    """The arrays (M, *row) of all parts, memory-mapped where they are large: copied, unless there
    is one part alone.

    Raises:
        OSError: the disk is full.
    """
    if len(parts) == 1:
        return parts[0]
    return [_join(list(arrays), folder) for arrays in zip(*parts, strict=True)]


def _join(parts: list[Array], folder: Path | None) -> Array:
    """(M, *row) parts one after another, memory-mapped where they are large."""
    out = empty((sum(map(len, parts)), *parts[0].shape[1:]), parts[0].dtype, folder)
    first = 0
    for part in parts:
        for block in iter_blocks(part):
            out[first + block.start : first + block.stop] = part[block]
            release_pages(out)
        first += len(part)
    return out
