"""Point clouds from files, one by one, into a recording; the clock of their time column."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.camera import Images
from stillmap.core.errors import InputError, MissingExtra
from stillmap.core.recording import Recording
from stillmap.core.source import Source
from stillmap.core.timestamps import MAX_BEAM_TIME, MAX_STAMP_NS
from stillmap.io.builder import ReadContext, RecordingBuilder, SkippedRecords
from stillmap.io.point_cloud.origin import Origin
from stillmap.io.scan_files import list_files, stamps_from_names, strip_extension
from stillmap.prepare.options import MAX_POINT_DISTANCE
from stillmap.prepare.time_window import TimeWindow

_MAX_NAMES = 5  # of skipped files in a warning

_TIME_NAMES = ("t", "time", "timestamp", "timestamps", "time_stamp", "offset_time", "time_offset")
_UNITS = (1, 10**3, 10**6, 10**9)  # per second: s, ms, us, ns
_SINCE_1970 = (6e8, 5e9)  # s: the years 1989 to 2128
# the limits differ by less than 1000: at most one unit fits
_SCAN_DURATION = (0.005, 2.0)  # s
_PERIOD_SHARE = (0.05, 1.5)  # duration of a scan over the time between stamps
_SAME_CLOCK_NS = 10 * 10**9


class Cloud(NamedTuple):
    """One scan of a file.

    Attributes:
        points: (n, 3) metres in the sensor frame.
        T: (4, 4) sensor pose; None: not recorded.
        times: (n,) as recorded; None: not recorded.
        stamp_ns: stamp; None: not recorded.
    """

    points: NDArray[Any]
    T: NDArray[np.float64] | None = None
    times: NDArray[Any] | None = None
    stamp_ns: int | None = None


class CloudSource(NamedTuple):
    """A cloud to be read: its name in messages, and its stamp where known in advance."""

    name: str
    read: Callable[[], Cloud]
    stamp_ns: int | None = None


def read_clouds(
    path: Path,
    format: str,
    extensions: tuple[str, ...],
    read_cloud: Callable[..., Cloud],
    context: ReadContext,
) -> Recording:
    """Read a file or folder of clouds without sensor poses.

    Args:
        path: of the file or folder.
        format: its name.
        extensions: of its files.
        read_cloud: reads one file, given the common `origin` and a `scratch` folder.
        context: see ReadContext.

    Raises:
        InputError: no cloud can be read.
    """
    origin = Origin()
    read_cloud = partial(read_cloud, origin=origin, scratch=context.scratch)
    sources = sources_of(files_of(path, extensions), extensions, read_cloud)
    notes = Source(str(path), format=format)
    recording = build_recording(sources, notes, context, single=path.is_file())
    origin.add_notes(recording)
    return recording


def files_of(path: Path, extensions: tuple[str, ...]) -> list[Path]:
    """A file itself, or the files of a folder."""
    return [path] if path.is_file() else list_files(path, extensions)


def sources_of(
    files: Sequence[Path], extensions: tuple[str, ...], read_cloud: Callable[[Path], Cloud]
) -> list[CloudSource]:
    """A source per file, with the stamp that its name holds."""
    names = [strip_extension(file.name, extensions) for file in files]
    stamps: Sequence[int | None] = stamps_from_names(names) or [None] * len(files)
    return [
        CloudSource(file.name, partial(read_cloud, file), stamp)
        for file, stamp in zip(files, stamps, strict=True)
    ]


def build_recording(
    sources: Sequence[CloudSource],
    notes: Source,
    context: ReadContext,
    *,
    single: bool = False,
    images: Images | None = None,
) -> Recording:
    """Build a recording from clouds; unreadable ones are skipped and counted.

    Args:
        sources: in order; scans without stamps are taken one second apart.
        notes: on the file or folder; more are added.
        context: see ReadContext; the one sensor is the base of the robot.
        single: whether it is one file: damage is an error, nothing is skipped.
        images: of the recording; None: there are none.

    Raises:
        InputError: no cloud can be read, or a library is missing.
    """
    window, skipped, lost = TimeWindow(context.options), SkippedRecords(), list[str]()
    scans = _ScanBuilder(sources, notes.warnings, context, window)
    known = [source.stamp_ns for source in sources if source.stamp_ns is not None]
    wanted = dict(zip(known, window.select_all(np.array(known, np.int64)).tolist(), strict=True))
    for number, source in enumerate(sources):
        if source.stamp_ns is not None and not wanted[source.stamp_ns]:
            continue
        try:
            cloud = _read_source(source)
            if single and not len(cloud.points):
                raise InputError("holds no points", where=str(notes.path))
            scans.add(number, source.stamp_ns, cloud)
        except InputError as error:
            if single or isinstance(error, MissingExtra):
                raise
            skipped.add(error.what.partition(":")[0], number + 1)
            lost.append(source.name)
        if context.progress is not None:
            context.progress((number + 1) / len(sources))
    window.require_scans(str(notes.path))
    if not scans.numbers:
        reasons = f"usable scan: {skipped.summary('file')}" if skipped.total else "scan"
        raise InputError(f"holds no {reasons}", where=str(notes.path))
    if lost:
        shown = ", ".join(lost[:_MAX_NAMES]) + (", ..." if len(lost) > _MAX_NAMES else "")
        notes.warnings.append(f"skipped {len(lost)} of {len(sources)}: {shown}")
    notes.skipped, notes.skipped_unit, notes.part = skipped.by_reason(), "file", window.part
    return scans.build(notes, window.select_images(images))


def reject(file: Path, what: str) -> Cloud:
    """The reader of a file that is known to be unusable."""
    raise InputError(what, where=str(file))


def _read_source(source: CloudSource) -> Cloud:
    try:
        return source.read()
    except MemoryError:
        raise InputError("does not fit into memory", where=source.name) from None
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=source.name) from error


class _ScanBuilder:
    """Collects clouds; the first one decides whether points have times."""

    def __init__(
        self,
        sources: Sequence[CloudSource],
        warnings: list[str],
        context: ReadContext,
        window: TimeWindow,
    ) -> None:
        self._warnings, self._scratch, self._window = warnings, context.scratch, window
        self._period = _median_period(sources)
        self._builder: RecordingBuilder | None = None
        self._clock: Clock | None = None
        self._poses: list[NDArray[np.float64] | None] = []
        self.numbers: list[int] = []
        self._without_stamp = 0

    def add(self, number: int, stamp_ns: int | None, cloud: Cloud) -> None:
        points = cloud.points
        is_selected = stamp_ns is not None  # else its stamp is known from now on
        if self._builder is None:
            if cloud.times is not None:
                self._clock = detect_clock(cloud.times[_usable_mask(points)], self._period)
                if self._clock is None:
                    text = "the time field is ignored: no unit gives a plausible duration of a scan"
                    self._warnings.append(text)
            timed = self._clock is not None
            self._builder = RecordingBuilder(3, self._scratch, beam_times=timed)
        stamp_ns, beam_time = cloud.stamp_ns if stamp_ns is None else stamp_ns, None
        if self._clock is not None and cloud.times is not None:
            usable = _usable_mask(points)
            stamp_ns, beam_time = convert_times(cloud.times, usable, self._clock, stamp_ns)
        if stamp_ns is None:
            stamp_ns = number * 10**9
            self._without_stamp += 1
        if not is_selected and not self._window.select(stamp_ns):
            return
        self._builder.add_scan(stamp_ns, points, beam_time=beam_time)
        self._poses.append(cloud.T)
        self.numbers.append(number)

    def build(self, notes: Source, images: Images | None) -> Recording:
        assert self._builder is not None
        if self._without_stamp and len(self.numbers) > 1:
            text = f"{self._without_stamp} scans without a stamp are taken one second apart"
            self._warnings.append(text)
        return self._builder.build(
            np.eye(4)[None],
            source=notes,
            T_recorded_base=self._stack_poses(),
            record=np.array(self.numbers, np.int64),
            images=images,
        )

    def _stack_poses(self) -> NDArray[np.float64] | None:
        poses = [T for T in self._poses if T is not None]
        if not poses or all(np.array_equal(T, np.eye(4)) for T in poses):
            return None
        if len(poses) < len(self._poses):
            missing = len(self._poses) - len(poses)
            self._warnings.append(f"{missing} scans have no pose: poses are ignored")
            return None
        return np.stack(poses)


def _median_period(sources: Sequence[CloudSource]) -> float | None:
    """Median time between stamps in seconds; None: unknown."""
    stamps = [source.stamp_ns for source in sources if source.stamp_ns is not None]
    if len(stamps) < 2:
        return None
    return float(np.median(np.diff(np.sort(np.array(stamps, np.int64))))) / 1e9


def _usable_mask(points: NDArray[Any]) -> NDArray[np.bool_]:
    plausible = (np.abs(points) <= MAX_POINT_DISTANCE).all(axis=1)
    return np.asarray(plausible & np.any(points != 0, axis=1))


class Clock(NamedTuple):
    """Unit and epoch of a time column.

    Attributes:
        per_second: units per second.
        absolute: times count from 1970; else from the scan's stamp.
    """

    per_second: int
    absolute: bool


def find_time_column(names: Iterable[str]) -> str | None:
    """The name of the time column; None: there is none."""
    return next((name for name in names if name.lower() in _TIME_NAMES), None)


def detect_clock(values: NDArray[Any], period: float | None) -> Clock | None:
    """The one unit that gives a scan a plausible duration; None: none or several.

    Args:
        values: (n,) as recorded; not finite: unknown.
        period: seconds between stamps; None: unknown.
    """
    values = values[np.isfinite(values)] if values.dtype.kind == "f" else values
    if not len(values):
        return None
    first, last = float(values.min()), float(values.max())
    for unit in _UNITS:
        # absolute times differ by little within a scan
        if _SINCE_1970[0] < first / unit < _SINCE_1970[1] and last - first < 0.01 * first:
            return Clock(unit, True)
    limits = [_SCAN_DURATION]
    if period is not None and period > 0:
        limits.append((_PERIOD_SHARE[0] * period, _PERIOD_SHARE[1] * period))
    fitting = {
        unit for unit in _UNITS for low, high in limits if low <= (last - first) / unit <= high
    }
    return Clock(fitting.pop(), False) if len(fitting) == 1 else None


def convert_times(
    values: NDArray[Any], usable: NDArray[np.bool_], clock: Clock, stamp_ns: int | None
) -> tuple[int | None, NDArray[np.float64]]:
    """The stamp of a scan, and seconds (n,) from it to each point, NaN where unknown.

    Args:
        values: (n,) as recorded.
        usable: (n,) mask of valid points.
        clock: unit and epoch.
        stamp_ns: stamp of the scan; None: the first absolute time.
    """
    if not clock.absolute:
        return stamp_ns, _drop_outliers(values.astype(np.float64) / clock.per_second)
    unit = 10**9 // clock.per_second  # ns
    known = usable & np.isfinite(values) & (values > 0) & (values < MAX_STAMP_NS / unit)
    after = np.full(len(values), np.nan)
    if not known.any():
        return stamp_ns, after
    kept = values[known]
    if kept.dtype.kind == "f":
        ns = np.round(kept * float(unit)).astype(np.int64)
    else:  # integers stay exact
        ns = kept.astype(np.int64) * unit
    middle = np.partition(ns, len(ns) // 2)[len(ns) // 2]
    first = int(ns[np.abs(ns - middle) < int(MAX_BEAM_TIME * 1e9)].min())
    if stamp_ns is None:
        stamp_ns = first
    same_clock = abs(stamp_ns - first) < _SAME_CLOCK_NS
    after[known] = (ns - (stamp_ns if same_clock else first)) / 1e9
    return stamp_ns, _drop_outliers(after)


def _drop_outliers(seconds: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(np.abs(seconds) <= MAX_BEAM_TIME, seconds, np.nan)


@contextmanager
def library_errors(path: Path) -> Iterator[None]:
    """Turn errors of a library about damaged bytes into InputError."""
    try:
        with np.errstate(all="ignore"):
            yield
    except (InputError, MemoryError):
        raise
    except BaseException as error:
        # panics of Rust derive from BaseException
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        what = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"is damaged: {what}", where=str(path)) from error
