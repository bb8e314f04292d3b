"""Clouds, one after the other, as the scans of a recording.

Clouds without a place of their sensor, maybe far from the origin of their coordinates.

Clouds that do not say where their sensor was: single files, or folders of them.
"""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import ArrayBuilder
from stillmap.core.errors import InputError, MissingExtra
from stillmap.core.recording import Recording
from stillmap.io.builder import RecordingBuilder, SkippedRecords
from stillmap.io.point_cloud.files import list_files, stamps_from_names, strip_extension
from stillmap.io.point_cloud.time_field import Clock, convert_times, detect_clock
from stillmap.io.text_lines import Progress
from stillmap.preprocessing.options import MAX_POINT_DISTANCE, ReadOptions

_NAMED = 5  # skipped files that are named


class Cloud(NamedTuple):
    """One scan as a file holds it.

    Attributes:
        points: (n, 3) metres in the sensor's frame.
        T: (4, 4) where the sensor was, None where the file does not say.
        times: (n,) as recorded, None where there are none.
        stamp_ns: when it was taken, None where the file does not say.
    """

    points: NDArray[Any]
    T: NDArray[np.float64] | None = None
    times: NDArray[Any] | None = None
    stamp_ns: int | None = None


class CloudSource(NamedTuple):
    """A cloud that can be read: its name for people, its stamp if that is known before."""

    name: str
    read: Callable[[], Cloud]
    stamp_ns: int | None = None


class DatasetInfo(NamedTuple):
    """What is known of a recording before its clouds are read.

    Attributes:
        path: of the file or folder.
        format: for people.
        warnings: to begin with; more are added.
        single: one file: what is wrong with it is an error, nothing is skipped.
    """

    path: Path
    format: str
    warnings: list[str]
    single: bool = False


def build_recording(
    sources: Sequence[CloudSource],
    known: DatasetInfo,
    options: ReadOptions,
    progress: Progress | None = None,
    scratch: Path | None = None,
    **more: Any,
) -> Recording:
    """The recording of all clouds that can be read.

    Those that cannot are skipped and counted in `source["skipped"]` by their number from 1.

    Args:
        sources: in order. Where no stamps are known, they are taken a second apart.
        known: see Known.
        options: see ReadOptions; there is one sensor, and it is the robot's base.
        progress: called with the share that is read.
        scratch: folder for what does not fit into memory.
        more: other fields of the Recording.

    Raises:
        InputError: not one can be read, or a library is missing.
    """
    reject_laser_poses(options)
    skipped, scans = SkippedRecords(), _Scans(sources, known, options, scratch)
    lost: list[str] = []
    for number, source in enumerate(sources):
        try:
            cloud = _read(source)
            if known.single and not len(cloud.points):
                raise InputError("holds no points", where=str(known.path))
        except InputError as error:
            if known.single or isinstance(error, MissingExtra):
                raise
            skipped.add(error.what.partition(":")[0], number + 1)
            lost.append(source.name)
        else:
            scans.add(number, source.stamp_ns, cloud)
        if progress is not None:
            progress((number + 1) / len(sources))
    if not len(scans):
        raise no_usable_scan_error(known, skipped)
    if lost:
        shown = ", ".join(lost[:_NAMED]) + (", ..." if len(lost) > _NAMED else "")
        known.warnings.append(f"skipped {len(lost)} of {len(sources)}: {shown}")
    return scans.recording(skipped, **more)


def reject_laser_poses(options: ReadOptions) -> None:
    """Refuse options that place a laser on the robot.

    Raises:
        InputError: there are such.
    """
    options.check_laser_count(1)
    given = options.laser(0)
    if given.pose != (None, None, None) or given.upside_down or given.fov is not None:
        raise InputError("the laser's place on the robot can be given for 2D recordings only")


def no_usable_scan_error(known: DatasetInfo, skipped: SkippedRecords) -> InputError:
    """The error for a recording without a single scan that can be read."""
    what = f"holds no usable scan: {skipped.summary('file')}" if skipped.total else "holds no scan"
    return InputError(what, where=str(known.path))


def range_options_note(options: ReadOptions) -> dict[str, Any]:
    """The options that change what is there, for Recording.source."""
    default = ReadOptions()
    names = ("min_range", "max_range", "free_range")
    given = {n: getattr(options, n) for n in names if getattr(options, n) != getattr(default, n)}
    return {"read_options": given} if given else {}


def _read(source: CloudSource) -> Cloud:
    try:
        return source.read()
    except MemoryError:
        raise InputError("does not fit into memory", where=source.name) from None
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=source.name) from error


class _Scans:
    """Clouds on their way into a recording; the first one says whether points have times."""

    def __init__(
        self,
        sources: Sequence[CloudSource],
        known: DatasetInfo,
        options: ReadOptions,
        scratch: Path | None,
    ) -> None:
        self._known, self._options, self._scratch = known, options, scratch
        self._period = _period(sources)
        self._gathered: RecordingBuilder | None = None
        self._clock: Clock | None = None
        self._poses: list[NDArray[np.float64] | None] = []
        self._counted = 0

    def __len__(self) -> int:
        return len(self._poses)

    def add(self, number: int, stamp_ns: int | None, cloud: Cloud) -> None:
        points = cloud.points
        if self._gathered is None:
            self._clock = self._first_clock(cloud)
            self._gathered = RecordingBuilder(
                3, self._options, beam_times=self._clock is not None, folder=self._scratch
            )
        stamp_ns = cloud.stamp_ns if stamp_ns is None else stamp_ns
        beam_time = None
        if self._clock is not None and cloud.times is not None:
            stamp_ns, beam_time = convert_times(cloud.times, _usable(points), self._clock, stamp_ns)
        if stamp_ns is None:
            stamp_ns = number * 10**9
            self._counted += 1
        self._gathered.add_scan(stamp_ns, points, beam_time=beam_time)
        self._poses.append(cloud.T)

    def _first_clock(self, cloud: Cloud) -> Clock | None:
        if cloud.times is None:
            return None
        clock = detect_clock(cloud.times[_usable(cloud.points)], self._period)
        if clock is None:
            what = "the times of points are not used: no unit makes a sweep of them"
            self._known.warnings.append(what)
        return clock

    def recording(self, skipped: SkippedRecords, **more: Any) -> Recording:
        assert self._gathered is not None
        known, warnings = self._known, self._known.warnings
        if self._counted and len(self) > 1:
            warnings.append(f"{self._counted} scans without a time are taken a second apart")
        T = self._recorded_poses()
        source = {
            "path": str(known.path),
            "format": known.format,
            "skipped": skipped.to_dict(),
            "skipped_unit": "file",
            "warnings": warnings,
            **range_options_note(self._options),
        }
        return self._gathered.build(
            np.eye(4)[None], source=source, **{"T_recorded_base": T, **more}
        )

    def _recorded_poses(self) -> NDArray[np.float64] | None:
        found = [T for T in self._poses if T is not None]
        if not found or all(np.array_equal(T, np.eye(4)) for T in found):
            return None
        if len(found) < len(self._poses):
            missing = len(self._poses) - len(found)
            self._known.warnings.append(f"{missing} scans have no pose: poses are not used")
            return None
        return np.stack(found)


def _period(sources: Sequence[CloudSource]) -> float | None:
    """Seconds from scan to scan as stamps have it."""
    stamps = [source.stamp_ns for source in sources if source.stamp_ns is not None]
    if len(stamps) < 2:
        return None
    return float(np.median(np.diff(np.sort(np.array(stamps, np.int64))))) / 1e9


def _usable(points: NDArray[Any]) -> NDArray[np.bool_]:
    meant = (np.abs(points) <= MAX_POINT_DISTANCE).all(axis=1)
    return np.asarray(meant & np.any(points != 0, axis=1))


_NEAR = 4096.0  # m: so far single precision resolves half a millimetre

NO_SENSOR = "the file tells no place of a sensor: beams count as sent from the origin"


class Origin:
    """Where points are counted from, the same for all clouds of a recording.

    Points near the origin of their coordinates stay where they are. Others are moved by whole
    metres, found from the first block of points that is seen, unless `at` (3,) is given.
    """

    def __init__(self, at: NDArray[np.float64] | None = None) -> None:
        self.position = at

    def shift(self, points: NDArray[Any]) -> NDArray[np.float32]:
        """(n, 3) as seen from here, of points (n, 3) in metres as recorded."""
        points = np.asarray(points, np.float64)
        if self.position is None:
            self.position = _origin_of(points)
        with np.errstate(over="ignore"):
            return (points - (0.0 if self.position is None else self.position)).astype(np.float32)

    def notes(self) -> dict[str, Any]:
        """For Recording.source; known after the first cloud."""
        moved = self.position is not None and bool(np.any(self.position != 0.0))
        return (
            {"origin": [float(v) for v in self.position]}
            if moved and self.position is not None
            else {}
        )

    def warnings(self) -> list[str]:
        """What was assumed."""
        place = self.notes().get("origin")
        if place is None:
            return [NO_SENSOR]
        at = " ".join(f"{value:.0f}" for value in place)
        return [f"the file tells no place of a sensor: beams count as sent from {at}, the new zero"]


def _origin_of(points: NDArray[np.float64]) -> NDArray[np.float64] | None:
    finite = points[np.isfinite(points).all(axis=1)]
    if not len(finite):
        return None
    middle = np.median(finite, axis=0)
    return np.round(middle) if np.abs(middle).max() > _NEAR else np.zeros(3)


class PointBuffer:
    """(n, 3) points that come in blocks; in a file where they are many."""

    def __init__(self, origin: Origin, scratch: Path | None) -> None:
        self._origin = origin
        self._points = ArrayBuilder(np.float32, (3,), scratch)

    def add(self, points: NDArray[Any]) -> None:
        self._points.append(self._origin.shift(points))

    def finish(self) -> NDArray[np.float32]:
        return self._points.finish()


CloudReader = Callable[[Path, Origin, Path | None], Cloud]


def read_clouds(
    path: Path,
    name: str,
    endings: tuple[str, ...],
    cloud: CloudReader,
    options: ReadOptions,
    progress: Progress | None,
    scratch: Path | None,
) -> Recording:
    """The recording of a file, or of a folder of them.

    Args:
        path: of the file or folder.
        name: of the format.
        endings: of the names of such files.
        cloud: reads one, of a path, the common origin and a folder for what is large.
        options, progress, scratch: see `assembled`.

    Raises:
        InputError: no cloud can be read.
    """
    files = [path] if path.is_file() else list_files(path, endings)
    stamps = stamps_from_names([strip_extension(file.name, endings) for file in files])
    origin = Origin()
    known = DatasetInfo(path, name, [], single=path.is_file())
    sources = [
        CloudSource(file.name, partial(cloud, file, origin, scratch), stamps[i] if stamps else None)
        for i, file in enumerate(files)
    ]
    recording = build_recording(sources, known, options, progress, scratch)
    recording.source.update(origin.notes())
    recording.source["warnings"] += origin.warnings()
    return recording
