"""Point clouds from files, one by one, into a recording; their common origin, which may be that
of a country; hits to write."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_types import Bool, Float, Float32
from stillmap.core.arrays import finite_rows
from stillmap.core.camera import Images
from stillmap.core.errors import InputError, MissingExtra
from stillmap.core.local_frame import shift_poses
from stillmap.core.recording import Recording
from stillmap.core.source import Source
from stillmap.io.builder import ReadContext, RecordingBuilder, SkippedRecords, explain_failure
from stillmap.io.point_cloud.table import Clock, convert_times, detect_clock
from stillmap.io.text_lines import list_files, stamps_from_names, strip_extension
from stillmap.io.trajectory import MAX_TRANSLATION, embed_in_3d
from stillmap.prepare.options import MAX_POINT_DISTANCE
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
    T: Float | None = None
    times: NDArray[Any] | None = None
    stamp_ns: int | None = None


class CloudSource(NamedTuple):
    """A cloud to be read: its name in messages, and its stamp where known in advance."""

    name: str
    read: Callable[[], Cloud]
    stamp_ns: int | None = None


def read_clouds(
    notes: Source,
    extensions: tuple[str, ...],
    read_cloud: Callable[..., Cloud],
    context: ReadContext,
    *,
    in_sensor_frame: bool = False,
) -> Recording:
    """Read a file of one cloud, or a folder of such files, with the stamps that names hold.

    Args:
        notes: path and format.
        extensions: of the files.
        read_cloud: reads one file, given the common `origin` and a `scratch` folder.
        context: see ReadContext.
        in_sensor_frame: see `Origin.record_in`.

    Raises:
        InputError: no cloud can be read.
    """
    path, origin = Path(str(notes.path)), Origin()
    read_cloud = partial(read_cloud, origin=origin, scratch=context.scratch)
    files = files_of(path, extensions)
    names = [strip_extension(file.name, extensions) for file in files]
    stamps: Sequence[int | None] = stamps_from_names(names) or [None] * len(files)
    pairs = zip(files, stamps, strict=True)
    sources = [CloudSource(file.name, partial(read_cloud, file), stamp) for file, stamp in pairs]
    recording = build_recording(sources, notes, context, single=path.is_file())
    origin.record_in(recording, in_sensor_frame=in_sensor_frame)
    return recording


def files_of(path: Path, extensions: tuple[str, ...]) -> list[Path]:
    """A file itself, or the files of a folder."""
    return [path] if path.is_file() else list_files(path, extensions)


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
    known = [source.stamp_ns for source in sources if source.stamp_ns is not None]
    window = TimeWindow(context.options, min(known, default=None))
    scans, skipped = _ScanBuilder(known, notes.warnings, context, window), SkippedRecords()
    lost: list[str] = []
    for number, source in enumerate(sources):
        if source.stamp_ns is not None and not window.select(source.stamp_ns):
            continue
        try:
            with explain_failure(source.name):
                cloud = source.read()
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


class _ScanBuilder:
    """Collects clouds; the first one decides whether points have times."""

    def __init__(
        self,
        stamps: Sequence[int],
        warnings: list[str],
        context: ReadContext,
        window: TimeWindow,
    ) -> None:
        self._warnings, self._scratch, self._window = warnings, context.scratch, window
        self._period = _median_period(stamps)
        self._builder: RecordingBuilder | None = None
        self._clock: Clock | None = None
        self._poses: list[Float | None] = []
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

    def _stack_poses(self) -> Float | None:
        poses = [T for T in self._poses if T is not None]
        if not poses or all(np.array_equal(T, np.eye(4)) for T in poses):
            return None
        if len(poses) < len(self._poses):
            missing = len(self._poses) - len(poses)
            self._warnings.append(f"{missing} scans have no pose: poses are ignored")
            return None
        return np.stack(poses)


def _median_period(stamps: Sequence[int]) -> float | None:
    """Median time between stamps in seconds; None: unknown."""
    if len(stamps) < 2:
        return None
    return float(np.median(np.diff(np.sort(np.array(stamps, np.int64))))) / 1e9


def _usable_mask(points: NDArray[Any]) -> Bool:
    plausible = (np.abs(points) <= MAX_POINT_DISTANCE).all(axis=1)
    return np.asarray(plausible & np.any(points != 0, axis=1))


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


_BLOCK = 1 << 20  # beams transformed at once
_MAX_COORDINATE = 4096.0  # m: float32 resolves half a millimetre up to there


class Origin:
    """Common origin of all clouds of a recording, so that float32 coordinates stay precise.

    Unless `position` (3,) is given: zero where the first block of points is near the origin, else
    its median, rounded to metres.
    """

    def __init__(self, position: Float | None = None) -> None:
        self.position = position

    def shift(self, points: NDArray[Any]) -> Float32:
        """(n, 3) points relative to the origin, of recorded points (n, 3) in metres."""
        points = np.asarray(points, np.float64)
        if self.position is None:
            self.position = _find_origin(points)
        with np.errstate(over="ignore"):
            return (points - (0.0 if self.position is None else self.position)).astype(np.float32)

    def record_in(self, recording: Recording, *, in_sensor_frame: bool = False) -> None:
        """Record by how much points were shifted, in place.

        In the poses where a recording has some, of the scans whose points were shifted: those
        without a rotation and a position, beside others that have them. Else in its source, with a
        warning that the sensor is assumed there; not where points are `in_sensor_frame` and near
        its origin.
        """
        T = recording.T_recorded_base
        if T is not None:
            if self.position is not None:
                is_unplaced = np.equal(T, np.eye(4)).all(axis=(1, 2))
                T[is_unplaced, :3, 3] = self.position
            return
        if self.position is not None and np.any(self.position != 0.0):
            recording.source.origin = tuple(self.position.tolist())
            at = " ".join(f"{value:.0f}" for value in self.position)
            at = f"{at}, the new origin"
        elif in_sensor_frame:
            return
        else:
            at = "the origin"
        recording.source.warnings.append(f"no sensor pose is recorded: beams start at {at}")


def cloud_origin(recording: Recording) -> Float:
    """(3,) metres by which the coordinates of a recording's clouds were shifted in reading."""
    noted = recording.source.origin if recording.dimension == 3 else None
    origin = np.array(noted or (0.0, 0.0, 0.0))
    return origin if (np.abs(origin) < MAX_TRANSLATION).all() else np.zeros(3)


def place_clouds(recording: Recording, poses: Float | None) -> Float | None:
    """Poses (T, D+1, D+1) for writing; None: there are none, and the coordinates are as they were.

    Args:
        recording: T scans.
        poses: as the recording has them; None: there are none.
    """
    origin = cloud_origin(recording)
    if not origin.any() or recording.T_recorded_base is not None:
        return poses
    if poses is None:
        poses = np.tile(np.eye(4), (recording.n_scans, 1, 1))
    return shift_poses(poses, origin)


def _find_origin(points: Float) -> Float | None:
    finite = points[finite_rows(points)]
    if not len(finite):
        return None
    # column by column: np.median(axis=0) takes several times as long
    middle = np.array([np.median(column) for column in finite.T])
    return np.round(middle) if np.abs(middle).max() > _MAX_COORDINATE else np.zeros(3)


def sensor_poses(recording: Recording, T_map_base: Float | None) -> Float | None:
    """(T, 4, 4) sensor poses of robot poses (T, D+1, D+1), for writing; see `place_clouds`."""
    T = place_clouds(recording, T_map_base)
    return None if T is None else embed_in_3d(recording.T_map_sensor(T))


def scan_hits(recording: Recording, scan: int) -> tuple[Float32, Float32 | None]:
    """(n, 3) hits of a scan in the sensor frame, and their times (n,) or None."""
    beams = recording.beams_of(scan)
    hit = recording.hit[beams]
    times = None if recording.beam_time is None else recording.beam_time[beams][hit]
    return _to_3d(recording.points[beams][hit]), times


def iter_map_points(recording: Recording, T_map_base: Float) -> Iterator[Float]:
    """Yield all hits in the map frame in blocks (n, 3), in recording order.

    Args:
        recording: 2D hits lie at z = 0.
        T_map_base: (T, D+1, D+1).
    """
    for start in range(0, recording.n_beams, _BLOCK):
        hit = start + np.flatnonzero(recording.hit[start : start + _BLOCK])
        yield _to_3d(recording.end_points(hit, T_map_base))


def _to_3d(points: NDArray[Any]) -> NDArray[Any]:
    if points.shape[1] == 3:
        return points
    return np.column_stack([points, np.zeros(len(points), points.dtype)])


def describe_non_returns(recording: Recording) -> list[str]:
    """A sentence on the beams without a return, which clouds cannot hold; none if all returned."""
    n = recording.n_beams - int(np.count_nonzero(recording.hit))
    return [f"{n} beams without a return are left out"] if n else []
