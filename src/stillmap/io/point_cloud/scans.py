"""Scan builder: point clouds from files, one by one, into a recording."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.errors import InputError, MissingExtra
from stillmap.core.recording import Recording
from stillmap.io.builder import ReadContext, RecordingBuilder, SkippedRecords
from stillmap.io.point_cloud.origin import Origin
from stillmap.io.point_cloud.time_field import Clock, convert_times, detect_clock
from stillmap.io.scan_files import list_files, stamps_from_names, strip_extension
from stillmap.prepare.options import MAX_POINT_DISTANCE, ReadOptions
from stillmap.prepare.time_window import TimeWindow

_MAX_NAMES = 5  # of skipped files in a warning


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


class DatasetInfo(NamedTuple):
    """Description of the file or folder being read.

    Attributes:
        path: of the file or folder.
        format: name of the format.
        warnings: on the input; more are added.
        single: whether it is one file: damage is an error, nothing is skipped.
    """

    path: Path
    format: str
    warnings: list[str]
    single: bool = False


def build_recording(
    sources: Sequence[CloudSource], info: DatasetInfo, context: ReadContext, **more: Any
) -> Recording:
    """Build a recording from clouds; unreadable ones are skipped and counted in `source`.

    Args:
        sources: in order; scans without stamps are taken one second apart.
        info: see DatasetInfo.
        context: see ReadContext; the one sensor is the base of the robot.
        more: other fields of the Recording.

    Raises:
        InputError: no cloud can be read, or a library is missing.
    """
    _reject_laser_poses(context.options)
    window = TimeWindow(context.options)
    skipped, scans = SkippedRecords(), _ScanBuilder(sources, info, context, window)
    lost: list[str] = []
    known = [source.stamp_ns for source in sources if source.stamp_ns is not None]
    wanted = dict(zip(known, window.select_all(np.array(known, np.int64)).tolist(), strict=True))
    for number, source in enumerate(sources):
        if source.stamp_ns is not None and not wanted[source.stamp_ns]:
            continue
        try:
            cloud = _read_source(source)
            if info.single and not len(cloud.points):
                raise InputError("holds no points", where=str(info.path))
        except InputError as error:
            if info.single or isinstance(error, MissingExtra):
                raise
            skipped.add(error.what.partition(":")[0], number + 1)
            lost.append(source.name)
        else:
            scans.add(number, source.stamp_ns, cloud)
        if context.progress is not None:
            context.progress((number + 1) / len(sources))
    window.require_scans(str(info.path))
    if not len(scans):
        reasons = f"usable scan: {skipped.summary('file')}" if skipped.total else "scan"
        raise InputError(f"holds no {reasons}", where=str(info.path))
    if lost:
        shown = ", ".join(lost[:_MAX_NAMES]) + (", ..." if len(lost) > _MAX_NAMES else "")
        info.warnings.append(f"skipped {len(lost)} of {len(sources)}: {shown}")
    if "images" in more:
        more["images"] = window.select_images(more["images"])
    return scans.recording(skipped, **more)


def _reject_laser_poses(options: ReadOptions) -> None:
    """Refuse laser options, which are for 2D recordings.

    Raises:
        InputError: a pose, orientation or field of view is given.
    """
    options.check_laser_count(1)
    laser = options.laser(0)
    if laser.pose != (None, None, None) or laser.upside_down or laser.fov is not None:
        raise InputError("the laser's place on the robot can be given for 2D recordings only")


def reject(file: Path, what: str) -> Cloud:
    """The reader of a file that is known to be unusable."""
    raise InputError(what, where=str(file))


def _range_options_note(options: ReadOptions) -> dict[str, Any]:
    """The range options that are set, for Recording.source."""
    default = ReadOptions()
    names = ("min_range", "max_range", "free_range")
    given = {n: getattr(options, n) for n in names if getattr(options, n) != getattr(default, n)}
    return {"read_options": given} if given else {}


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
        info: DatasetInfo,
        context: ReadContext,
        window: TimeWindow,
    ) -> None:
        self._info, self._context, self._window = info, context, window
        self._period = _median_period(sources)
        self._gathered: RecordingBuilder | None = None
        self._clock: Clock | None = None
        self._poses: list[NDArray[np.float64] | None] = []
        self._numbers: list[int] = []
        self._without_stamp = 0

    def __len__(self) -> int:
        return len(self._poses)

    def add(self, number: int, stamp_ns: int | None, cloud: Cloud) -> None:
        points = cloud.points
        is_selected = stamp_ns is not None  # else its stamp is known from now on
        if self._gathered is None:
            if cloud.times is not None:
                self._clock = detect_clock(cloud.times[_usable_mask(points)], self._period)
                if self._clock is None:
                    text = "the time field is ignored: no unit gives a plausible duration of a scan"
                    self._info.warnings.append(text)
            timed = self._clock is not None
            self._gathered = RecordingBuilder(3, self._context, beam_times=timed)
        stamp_ns = cloud.stamp_ns if stamp_ns is None else stamp_ns
        beam_time = None
        if self._clock is not None and cloud.times is not None:
            stamp_ns, beam_time = convert_times(
                cloud.times, _usable_mask(points), self._clock, stamp_ns
            )
        if stamp_ns is None:
            stamp_ns = number * 10**9
            self._without_stamp += 1
        if not is_selected and not self._window.select(stamp_ns):
            return
        self._gathered.add_scan(stamp_ns, points, beam_time=beam_time)
        self._poses.append(cloud.T)
        self._numbers.append(number)

    def recording(self, skipped: SkippedRecords, **more: Any) -> Recording:
        assert self._gathered is not None
        info, warnings = self._info, self._info.warnings
        if self._without_stamp and len(self) > 1:
            text = f"{self._without_stamp} scans without a stamp are taken one second apart"
            warnings.append(text)
        T = self._stack_poses()
        source = {
            "path": str(info.path),
            "format": info.format,
            "skipped": skipped.to_dict(),
            "skipped_unit": "file",
            "warnings": warnings,
            **_range_options_note(self._context.options),
            **self._window.notes(),
        }
        return self._gathered.build(
            np.eye(4)[None],
            source=source,
            record=np.array(self._numbers, np.int64),
            **{"T_recorded_base": T, **more},
        )

    def _stack_poses(self) -> NDArray[np.float64] | None:
        found = [T for T in self._poses if T is not None]
        if not found or all(np.array_equal(T, np.eye(4)) for T in found):
            return None
        if len(found) < len(self._poses):
            missing = len(self._poses) - len(found)
            self._info.warnings.append(f"{missing} scans have no pose: poses are ignored")
            return None
        return np.stack(found)


def _median_period(sources: Sequence[CloudSource]) -> float | None:
    """Median time between stamps in seconds; None: unknown."""
    stamps = [source.stamp_ns for source in sources if source.stamp_ns is not None]
    if len(stamps) < 2:
        return None
    return float(np.median(np.diff(np.sort(np.array(stamps, np.int64))))) / 1e9


def _usable_mask(points: NDArray[Any]) -> NDArray[np.bool_]:
    plausible = (np.abs(points) <= MAX_POINT_DISTANCE).all(axis=1)
    return np.asarray(plausible & np.any(points != 0, axis=1))


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
    recording = build_recording(sources, DatasetInfo(path, format, [], path.is_file()), context)
    origin.add_notes(recording)
    return recording
