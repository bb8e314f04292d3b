"""Restriction of a recording to a part of its time: the options `read.start` and `read.end`."""

from dataclasses import replace

from stillmap.core.camera import Images
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.core.source import Part
from stillmap.core.timestamps import MAX_STAMP_NS, format_seconds
from stillmap.prepare.options import ReadOptions

ABSOLUTE = 1e8  # s: times from here on are stamps; no recording lasts three years

_ROUNDING = 1000  # ns: a stamp of today in seconds, as float64, is off by a quarter of that


class TimeWindow:
    """Selects scans by their stamps, in the order in which they are read.

    Times below `ABSOLUTE` count from the first scan that is read; a start of 0 is no limit, so that
    a second sensor's slightly earlier scan stays.

    Args:
        options: `start` and `end` apply.
        origin_ns: stamp from which times count; None: that of the first scan.

    Attributes:
        selected, omitted: numbers of scans inside and outside the window so far.
    """

    def __init__(self, options: ReadOptions, origin_ns: int | None = None) -> None:
        self._start, self._end = options.start or None, options.end
        self._origin_ns = origin_ns
        self._span_ns: tuple[int, int] | None = None  # of all scans so far
        self.selected = self.omitted = 0

    def __bool__(self) -> bool:
        """True if there is a limit."""
        return self._start is not None or self._end is not None

    def select(self, stamp_ns: int) -> bool:
        """True if a scan is to be read; counts it."""
        if self._origin_ns is None:
            self._origin_ns = stamp_ns
        first, last = self._span_ns or (stamp_ns, stamp_ns)
        self._span_ns = min(first, stamp_ns), max(last, stamp_ns)
        inside = self.contains(stamp_ns)
        self.selected += inside
        self.omitted += not inside
        return inside

    def contains(self, stamp_ns: int) -> bool:
        """True if something with a stamp, an image say, lies inside; not counted."""
        start, end = self._limit_ns(self._start, -1), self._limit_ns(self._end, 1)
        return start - _ROUNDING <= stamp_ns <= end + _ROUNDING

    def select_images(self, images: Images | None) -> Images | None:
        """The images inside the window; None where there are none."""
        if images is None or not self:
            return images
        inside = [k for k, stamp in enumerate(images.stamp_ns.tolist()) if self.contains(stamp)]
        if not inside:
            return None
        return Images(
            images.stamp_ns[inside],
            images.camera[inside],
            images.cameras,
            lambda image: images.load(inside[image]),
        )

    def _limit_ns(self, seconds: float | None, side: int) -> int:
        if seconds is not None and seconds >= ABSOLUTE:
            return round(seconds * 1e9)
        if seconds is None or self._origin_ns is None:
            return side * 2 * MAX_STAMP_NS
        return self._origin_ns + round(seconds * 1e9)

    def require_scans(self, where: str = "") -> None:
        """Refuse a window that leaves nothing of a recording.

        Raises:
            InputError: there were scans, all of them outside.
        """
        if self.selected or self._span_ns is None:
            return
        limits = (("from", self._start), ("to", self._end))
        wanted = [f"{word} {at:.10g} s" for word, at in limits if at is not None]
        first, last = map(format_seconds, self._span_ns)
        span = (self._span_ns[1] - self._span_ns[0]) / 1e9
        hint = f"the recording spans 0 to {span:.2f} s, stamps {first} to {last}"
        raise InputError(f"has no scan {' '.join(wanted)}", where=where, hint=hint)

    @property
    def part(self) -> Part | None:
        """The part that was read, as `Recording.source` notes it; None without limits."""
        if not self or self._span_ns is None:
            return None
        return Part(*self._span_ns, omitted=self.omitted, start=self._start, end=self._end)


def select_time(recording: Recording, window: TimeWindow, where: str = "") -> Recording:
    """The scans and images of a recording in a window; `where` is its path, for messages.

    Raises:
        InputError: there is no such scan.
    """
    scans = [t for t, stamp in enumerate(recording.stamp_ns.tolist()) if window.select(stamp)]
    window.require_scans(where)
    if not scans:
        return recording
    return replace(
        recording.slice_scans(scans[0], scans[-1] + 1),  # stamps do not decrease
        images=window.select_images(recording.images),
        source=replace(recording.source, part=window.part or recording.source.part),
    )
