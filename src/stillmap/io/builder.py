"""Builds a recording scan by scan, of any size, and counts the records that were skipped."""

from array import array
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_builder import ArrayBuilder
from stillmap.core.array_types import Float, Index, Int64
from stillmap.core.arrays import empty, squared_lengths
from stillmap.core.errors import InputError, advise
from stillmap.core.recording import Recording
from stillmap.core.source import Skipped, Source
from stillmap.core.timestamps import MAX_BEAM_TIME, order_in_time
from stillmap.io.text_lines import Progress, share_progress
from stillmap.prepare.options import MAX_POINT_DISTANCE, ReadOptions

_BLOCK = 1 << 20  # points of a scan at a time


class ReadContext(NamedTuple):
    """Options, progress callback and scratch folder of a reader.

    Attributes:
        options: see ReadOptions.
        progress: called with the share of the input that is read, 0 to 1; None: nobody asks.
        scratch: folder of memory-mapped buffers; None: the system's temporary folder.
    """

    options: ReadOptions
    progress: Progress | None = None
    scratch: Path | None = None


def part_context(context: ReadContext, number: int, count: int) -> ReadContext:
    """The context of one of `count` parts of a run, which is read as a whole.

    The time window counts from the start of the run: it applies to the joined recording.
    """
    options = replace(context.options, start=None, end=None)
    progress = share_progress(context.progress, number, count)
    return ReadContext(options, progress, context.scratch)


@contextmanager
def explain_failure(path: str | Path) -> Iterator[None]:
    """Within this context, files that vanish and full disks are errors of the input.

    Raises:
        InputError: it names the file.
    """
    try:
        # damaged numbers are handled by the readers: no warnings of NumPy
        with np.errstate(over="ignore", invalid="ignore"):
            yield
    except InputError as error:
        if error.where:
            raise
        raise InputError(error.what, where=str(path), hint=error.hint) from error
    except (OSError, MemoryError) as error:
        # files may vanish and disks fill up at any moment
        what, where = "does not fit into memory", path
        if isinstance(error, OSError):
            what, where = f"cannot be read: {error.strerror or error}", error.filename or path
        raise InputError(what, where=str(where)) from error


class RecordingBuilder:
    """Collects point clouds, in any order, in memory-mapped buffers.

    Attributes:
        stamp_ns, length, sensor: stamp, number of points and sensor of each scan, as added.

    Args:
        dimension: D, 2 or 3.
        scratch: folder of the buffers; None: the system's temporary folder.
        beam_times: whether scans have beam times.
    """

    def __init__(self, dimension: int, scratch: Path | None, *, beam_times: bool = False) -> None:
        self._folder = scratch
        self.stamp_ns, self.length, self.sensor = array("q"), array("q"), array("i")
        self._points = ArrayBuilder(np.float32, (dimension,), self._folder)
        self._hit = ArrayBuilder(np.bool_, (), self._folder)
        self._times = ArrayBuilder(np.float32, (), self._folder) if beam_times else None

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def add_scan(
        self,
        stamp_ns: int,
        points: NDArray[Any],
        *,
        sensor: int = 0,
        beam_time: NDArray[Any] | None = None,
    ) -> None:
        """Add a scan.

        Args:
            stamp_ns: its time.
            points: (n, D) metres in the sensor's frame, larger than memory at will; not finite or
                implausibly far ones are unusable.
            sensor: index of its sensor.
            beam_time: (n,) seconds after the stamp; implausible ones count as 0.
        """
        for start in range(0, len(points), _BLOCK):
            block = slice(start, start + _BLOCK)
            known = np.asarray(points[block], np.float32)
            length = np.sqrt(squared_lengths(known))
            usable = (length <= MAX_POINT_DISTANCE) & (length > 0.0)
            if not usable.all():
                known = np.where(usable[:, None], known, np.float32(np.nan))
            self._points.append(known)
            self._hit.append(usable)
            if self._times is not None:
                times = np.zeros(len(known)) if beam_time is None else beam_time[block]
                self._times.append(np.where(np.abs(times) <= MAX_BEAM_TIME, times, 0.0))
        self.stamp_ns.append(stamp_ns)
        self.length.append(len(points))
        self.sensor.append(sensor)

    def build(
        self,
        T_base_sensor: Float,
        *,
        source: Source,
        T_odom_base: Float | None = None,
        T_recorded_base: Float | None = None,
        record: Int64 | None = None,
        selection: Index | None = None,
        **more: Any,
    ) -> Recording:
        """Build the recording, ordered by stamps; afterwards nothing can be added.

        Args:
            T_base_sensor: (S, D+1, D+1).
            source: see Recording.
            T_odom_base, T_recorded_base: (T, D+1, D+1) in the order in which scans were added.
            record: (T,) likewise; see Recording.
            selection: indices of the scans to use; None: all.
            more: other fields of the Recording.
        """
        stamp_ns = np.asarray(self.stamp_ns, np.int64)
        length = np.asarray(self.length, np.int64)
        selection = np.arange(len(stamp_ns)) if selection is None else np.sort(selection)
        order = selection[np.argsort(stamp_ns[selection], kind="stable")]

        def reorder(column: ArrayBuilder) -> NDArray[Any]:
            return reorder_scans(column.finish(), length, order, self._folder)

        return Recording(
            stamp_ns=stamp_ns[order],
            offset=np.concatenate([[0], np.cumsum(length[order])]).astype(np.int64),
            points=reorder(self._points),
            hit=reorder(self._hit),
            T_base_sensor=T_base_sensor,
            sensor=np.asarray(self.sensor, np.int32)[order],
            T_odom_base=None if T_odom_base is None else T_odom_base[order],
            source=source,
            beam_time=None if self._times is None else reorder(self._times),
            T_recorded_base=None if T_recorded_base is None else T_recorded_base[order],
            record=None if record is None else record[order],
            **more,
        )


def reorder_scans(
    values: NDArray[Any], length: Int64, order: Index, folder: Path | None
) -> NDArray[Any]:
    """Values per beam (M, ...) of scans with these numbers of beams, in another order of scans.

    Args:
        values: scan after scan.
        length: (T,) beams of each scan.
        order: (t,) indices of the scans to keep.
        folder: of a memory-mapped array; None: the system's temporary folder.
    """
    if np.array_equal(order, np.arange(len(length))):
        return values
    start = np.cumsum(length) - length
    out = empty((int(length[order].sum()), *values.shape[1:]), values.dtype, folder)
    at = 0
    for scan in order:
        first, n = int(start[scan]), int(length[scan])
        out[at : at + n] = values[first : first + n]
        at += n
    return out


MAX_LINE_NUMBERS = 1000

TIME_BACKWARDS = "time running backwards"

_MAX_LOSS = 0.05  # share of scans that may be skipped without a warning


class SkippedRecords:
    """Skipped records by reason: their numbers, of lines or messages."""

    def __init__(self) -> None:
        self._numbers: dict[str, array[int]] = {}

    def add(self, reason: str, number: int) -> None:
        self.add_all(reason, (number,))

    def add_all(self, reason: str, numbers: Iterable[int]) -> None:
        for number in numbers:
            self._numbers.setdefault(reason, array("q")).append(number)

    def order_in_time(self, stamp_ns: Int64, numbers: Int64) -> Index:
        """Indices of records in order of time; those without a place in it are counted.

        Args:
            stamp_ns, numbers: (T,) of the records in the order in which they were recorded.
        """
        order = order_in_time(stamp_ns)
        self.add_all(TIME_BACKWARDS, np.delete(numbers, order))
        return order

    def merge(self, *others: "SkippedRecords") -> "SkippedRecords":
        """The sum of these and others; neither is changed."""
        out = SkippedRecords()
        for part in (self, *others):
            for reason, numbers in part._numbers.items():
                out.add_all(reason, numbers)
        return out

    @property
    def total(self) -> int:
        return sum(map(len, self._numbers.values()))

    def summary(self, unit: str = "line") -> str:
        """`3 x unreadable number (line 4, 8, 15)`, the most frequent reason first.

        Args:
            unit: of the numbers.
        """
        parts = []
        for reason, numbers in sorted(self._numbers.items(), key=lambda item: -len(item[1])):
            shown = ", ".join(map(str, sorted(numbers)[:3])) + ", ..." * (len(numbers) > 3)
            parts.append(f"{len(numbers)} x {reason} ({unit} {shown})")
        return "; ".join(parts)

    def loss_warnings(self, kept: int, unit: str = "line") -> list[str]:
        """A warning where more than a few of the scans were skipped, of which `kept` remain."""
        if self.total <= _MAX_LOSS * (kept + self.total):
            return []
        skipped = f"{self.total} of {kept + self.total} scans are damaged and were skipped"
        todo = "copy the recording again; if it was recorded so, look whether the map has gaps"
        return [advise(f"{skipped}: {self.summary(unit)}", todo)]

    def by_reason(self) -> dict[str, Skipped]:
        """As `Recording.source` notes them, with the first `MAX_LINE_NUMBERS` numbers each."""
        return {
            reason: Skipped(len(numbers), sorted(numbers)[:MAX_LINE_NUMBERS])
            for reason, numbers in self._numbers.items()
        }
