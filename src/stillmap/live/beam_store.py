"""The beams of all scans in temporary files, with a bound on what they take."""

import logging
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from stillmap.core.array_builder import QUICKLY_WRITTEN, ArrayBuilder, append_together
from stillmap.core.arrays import empty, iter_blocks, release_pages

Array = NDArray[Any]

_log = logging.getLogger(__name__)

_IN_MEMORY_IF_FULL = 128 << 20  # bytes, about, of all arrays while the disk is full
_SEGMENTS = 16  # into which the bound is divided
_MIN_SCANS = 16  # of a segment: of few ones hardly any could be dropped
# steps between two scans, and scans and beams that a step copies: about 1 ms, in 3D 5 ms
_STEPS, _SCANS_PER_STEP, _BEAMS_PER_STEP = 4, 16, 20_000


class BeamStore:
    """Beams of scans, appended. Where they take more than the bound, every second one of the scans
    that lie most densely is dropped, the oldest first; a part of that work is done with each scan.
    While the disk is full scans are kept in memory, within a bound, and dropped likewise.

    Args:
        fields: dtype and shape of a row of each array.
        folder: of the temporary files; None: the system's.
        max_bytes: of all arrays, about; None: unbounded.

    Attributes:
        was_full: the disk was full, or could not be written to for another reason.
    """

    def __init__(
        self,
        fields: Sequence[tuple[DTypeLike, tuple[int, ...]]],
        folder: Path | None,
        max_bytes: int | None,
    ) -> None:
        self._fields, self._folder = fields, folder
        self._max_bytes = np.inf if max_bytes is None else max_bytes
        self.was_full = False
        self._segments = [self._make_segment()]
        self._work: Iterator[None] = iter(())

    def append(self, number: int, rows: list[Array]) -> None:
        """Append the beams of a scan.

        Args:
            number: of the scan; they rise.
            rows: (N, *row) of each array.
        """
        self._append(self._segments[-1], np.array([number]), np.array([len(rows[0])]), rows)
        if self._max_bytes == np.inf and not self.was_full:
            return
        if self._segments[-1].is_full(self._max_bytes / _SEGMENTS):
            self._segments.append(self._make_segment())
        for _ in range(_STEPS):
            if next(self._work, self) is self:
                self._work = self._thin_if_due()

    def _append(self, to: "_Segment", numbers: Array, counts: Array, rows: list[Array]) -> None:
        try:
            to.append(numbers, counts, rows)
        except OSError as error:  # they are in memory
            if not self.was_full:
                self._report(error)
            self.was_full = True

    def _report(self, error: OSError) -> None:
        _log.warning(
            "%s: %s; mapping goes on. Until temporary files can be written again, scans are kept "
            "in %d MB of memory: beyond, every second one is dropped, later its pose as well",
            self._folder or tempfile.gettempdir(),
            error.strerror or error,
            _IN_MEMORY_IF_FULL >> 20,
        )

    @property
    def kept(self) -> NDArray[np.int64]:
        """(K,) numbers of the scans that are kept, ascending."""
        self._finish()
        return np.concatenate([segment.numbers.view() for segment in self._segments])

    def has(self, numbers: Array) -> NDArray[np.bool_]:
        """(n,) which of the scans with numbers (n,) are kept."""
        return np.isin(numbers, np.concatenate([one.numbers.view() for one in self._segments]))

    @property
    def counts(self) -> NDArray[np.int64]:
        """(K,) number of beams of these scans."""
        self._finish()
        return np.concatenate([segment.counts.view() for segment in self._segments])

    def parts(self) -> list[list[Array]]:
        """Each array of the scans that are kept, in parts for `join_parts`; more scans may be
        appended."""
        self._finish()
        for segment in self._segments:
            segment.try_to_write()  # of one part no copy is needed
        fields = zip(*(segment.arrays for segment in self._segments), strict=True)
        return [[part for array in field for part in array.parts()] for field in fields]

    def files(self) -> list[list[IO[bytes] | None]]:
        """The file of each of `parts`, asked for after them; None: it is in memory."""
        fields = zip(*(segment.arrays for segment in self._segments), strict=True)
        return [[file for array in field for file in array.files()] for field in fields]

    def close(self) -> None:
        """Remove the files."""
        for segment in self._segments:
            segment.close()

    def _finish(self) -> None:
        """Finish what was begun: until then some scans are there twice."""
        for _ in self._work:
            pass

    def _make_segment(self) -> "_Segment":
        fields = [*self._fields, (np.int64, ()), (np.int64, ())]
        return _Segment([ArrayBuilder(t, row, self._folder, QUICKLY_WRITTEN) for t, row in fields])

    def _thin_if_due(self) -> Iterator[None]:
        """Begin to thin if more than the bound is held; the steps, or none."""
        in_memory = self.was_full and self._sum("memory_bytes") > _IN_MEMORY_IF_FULL
        on_disk = self._sum("byte_count") > self._max_bytes
        if not in_memory and not on_disk:
            return iter(())
        newest = 1 if len(self._segments[-1].numbers) else 2  # with the last scan, which stays
        room = max(_free_bytes(self._folder), _IN_MEMORY_IF_FULL // 2)
        may_be_thinned = [
            segment
            for segment in self._segments[:-newest]
            if (on_disk or segment.memory_bytes) and segment.byte_count / 2 <= room
        ]
        if not may_be_thinned:
            return iter(())
        densest = min(may_be_thinned, key=lambda segment: segment.halvings)
        if not on_disk:
            densest.try_to_write()  # perhaps there is room again
            if self._sum("memory_bytes") <= _IN_MEMORY_IF_FULL:
                return iter(())
        return self._thin(densest)

    def _sum(self, name: str) -> int:
        return sum(getattr(segment, name) for segment in self._segments)

    def _thin(self, old: "_Segment") -> Iterator[None]:
        """Drop every second scan of a segment; it joins the one before if that is as dense then
        and has room."""
        at, thinned = self._segments.index(old), self._make_segment()
        thinned.halvings = old.halvings + 1
        before = self._segments[at - 1] if at else None
        most = self._max_bytes if self._max_bytes < np.inf else _IN_MEMORY_IF_FULL
        if (
            before is not None
            and before.halvings == thinned.halvings
            and before.has_room(old, most / _SEGMENTS)
        ):
            thinned = before
        for rows in _iter_every_second(old):
            self._append(thinned, *rows)
            yield
        self._segments[at : at + 1] = [] if thinned is before else [thinned]
        old.close()
        if self.was_full:
            thinned.try_to_write()  # there was no room until now


class _Segment:
    """Scans one after another, of which every second one was dropped `halvings` times."""

    def __init__(self, every: list[ArrayBuilder]) -> None:
        self._every = every
        *self.arrays, self.numbers, self.counts = every
        self.byte_count, self.halvings = 0, 0

    @property
    def memory_bytes(self) -> int:
        return sum(array.memory_bytes for array in self._every)

    def append(self, numbers: Array, counts: Array, rows: list[Array]) -> None:
        """Append scans; if the disk is full, an OSError says so, and they are in memory."""
        self.byte_count += sum(a.nbytes for a in rows)
        append_together(zip(self._every, (*rows, numbers, counts), strict=True))

    def try_to_write(self) -> None:
        """Write what is in memory, if there is room."""
        with suppress(OSError):
            for array in self._every:
                array.write()

    def is_full(self, most: float) -> bool:
        """True if the segment holds more than `most` bytes, or much in memory, in several scans."""
        is_large = self.byte_count > most or self.memory_bytes > _IN_MEMORY_IF_FULL / _SEGMENTS
        return is_large and len(self.numbers) >= _MIN_SCANS

    def has_room(self, other: "_Segment", most: float) -> bool:
        """True if half of the bytes of another segment fit in, too."""
        fits = self.byte_count + 0.5 * other.byte_count <= 1.1 * most
        return fits or len(self.numbers) < _MIN_SCANS

    def close(self) -> None:
        for array in self._every:
            array.close()


def _iter_every_second(segment: _Segment) -> Iterator[tuple[Array, Array, list[Array]]]:
    """Every second scan of a segment, some at a time: their numbers, counts and rows."""
    arrays = [array.parts() for array in segment.arrays]
    numbers, counts = segment.numbers.view(), segment.counts.view()
    end = np.cumsum(counts)
    step = int(np.clip(_BEAMS_PER_STEP * len(counts) // max(end[-1], 1), 1, _SCANS_PER_STEP))
    for first in range(0, len(numbers), step):
        scans = slice(first, first + step)
        beams = slice(int(end[first] - counts[first]), int(end[scans][-1]))
        kept = (np.arange(len(numbers[scans])) + first) % 2 == 0
        of_kept = np.repeat(kept, counts[scans])
        yield numbers[scans][kept], counts[scans][kept], [_rows(a, beams)[of_kept] for a in arrays]


def _rows(parts: list[Array], which: slice) -> Array:
    """Consecutive rows of an array in parts."""
    found, first = [], 0
    for part in parts:
        found.append(part[max(which.start - first, 0) : max(which.stop - first, 0)])
        first += len(part)
        release_pages(part)
    return found[0] if len(found) == 1 else np.concatenate(found)


def _free_bytes(folder: Path | None) -> int:
    """Of the disk of a folder; 0: unknown."""
    with suppress(OSError):
        return shutil.disk_usage(folder or tempfile.gettempdir()).free
    return 0


def join_parts(fields: list[list[Array]], folder: Path | None) -> list[Array]:
    """The arrays (M, *row) of all parts, memory-mapped where they are large: copied, unless each is
    one part alone.

    Raises:
        OSError: the disk is full.
    """
    return [parts[0] if len(parts) == 1 else _join(parts, folder) for parts in fields]


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
