"""Clouds, one after the other, as the scans of a recording."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.errors import InputError
from stillmap.extras import MissingExtra
from stillmap.recording.clouds.point_times import Clock, clock_of, since
from stillmap.recording.gathering import Gathered
from stillmap.recording.lines import Progress
from stillmap.recording.model import Recording
from stillmap.recording.options import FARTHEST, ReadOptions
from stillmap.recording.skipped import Skipped

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


class Source(NamedTuple):
    """A cloud that can be read: its name for people, its stamp if that is known before."""

    name: str
    read: Callable[[], Cloud]
    stamp_ns: int | None = None


class Known(NamedTuple):
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


def assembled(
    sources: Sequence[Source],
    known: Known,
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
    refuse_places(options)
    skipped, scans = Skipped(), _Scans(sources, known, options, scratch)
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
        raise nothing_usable(known, skipped)
    if lost:
        shown = ", ".join(lost[:_NAMED]) + (", ..." if len(lost) > _NAMED else "")
        known.warnings.append(f"skipped {len(lost)} of {len(sources)}: {shown}")
    return scans.recording(skipped, **more)


def refuse_places(options: ReadOptions) -> None:
    """Refuse options that place a laser on the robot.

    Raises:
        InputError: there are such.
    """
    options.require_lasers(1)
    given = options.laser(0)
    if given.place != (None, None, None) or given.upside_down or given.fov is not None:
        raise InputError("the laser's place on the robot can be given for 2D recordings only")


def nothing_usable(known: Known, skipped: Skipped) -> InputError:
    """The error for a recording without a single scan that can be read."""
    what = f"holds no usable scan: {skipped.summary('file')}" if skipped.total else "holds no scan"
    return InputError(what, where=str(known.path))


def narrowing(options: ReadOptions) -> dict[str, Any]:
    """The options that change what is there, for Recording.source."""
    default = ReadOptions()
    names = ("min_range", "max_range", "free_range")
    given = {n: getattr(options, n) for n in names if getattr(options, n) != getattr(default, n)}
    return {"read_options": given} if given else {}


def _read(source: Source) -> Cloud:
    try:
        return source.read()
    except MemoryError:
        raise InputError("does not fit into memory", where=source.name) from None
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=source.name) from error


class _Scans:
    """Clouds on their way into a recording; the first one says whether points have times."""

    def __init__(
        self, sources: Sequence[Source], known: Known, options: ReadOptions, scratch: Path | None
    ) -> None:
        self._known, self._options, self._scratch = known, options, scratch
        self._period = _period(sources)
        self._gathered: Gathered | None = None
        self._clock: Clock | None = None
        self._poses: list[NDArray[np.float64] | None] = []
        self._counted = 0

    def __len__(self) -> int:
        return len(self._poses)

    def add(self, number: int, stamp_ns: int | None, cloud: Cloud) -> None:
        points = cloud.points
        if self._gathered is None:
            self._clock = self._first_clock(cloud)
            self._gathered = Gathered(
                3, self._options, beam_times=self._clock is not None, folder=self._scratch
            )
        stamp_ns = cloud.stamp_ns if stamp_ns is None else stamp_ns
        beam_time = None
        if self._clock is not None and cloud.times is not None:
            stamp_ns, beam_time = since(cloud.times, _usable(points), self._clock, stamp_ns)
        if stamp_ns is None:
            stamp_ns = number * 10**9
            self._counted += 1
        self._gathered.add(stamp_ns, points, beam_time=beam_time)
        self._poses.append(cloud.T)

    def _first_clock(self, cloud: Cloud) -> Clock | None:
        if cloud.times is None:
            return None
        clock = clock_of(cloud.times[_usable(cloud.points)], self._period)
        if clock is None:
            what = "the times of points are not used: no unit makes a sweep of them"
            self._known.warnings.append(what)
        return clock

    def recording(self, skipped: Skipped, **more: Any) -> Recording:
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
            **narrowing(self._options),
        }
        return self._gathered.recording(
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


def _period(sources: Sequence[Source]) -> float | None:
    """Seconds from scan to scan as stamps have it."""
    stamps = [source.stamp_ns for source in sources if source.stamp_ns is not None]
    if len(stamps) < 2:
        return None
    return float(np.median(np.diff(np.sort(np.array(stamps, np.int64))))) / 1e9


def _usable(points: NDArray[Any]) -> NDArray[np.bool_]:
    meant = (np.abs(points) <= FARTHEST).all(axis=1)
    return np.asarray(meant & np.any(points != 0, axis=1))
