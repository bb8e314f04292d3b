"""Scans as they arrive, until all that is needed to map them is there; no ROS in it.

message_filters has no such queue in Python: it pairs messages, and loses those without a partner.
"""

from bisect import insort
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from stillmap.core.array_types import Float
from stillmap.core.short_repr import ShortRepr
from stillmap.io.ros.clouds import find_layout
from stillmap.io.ros.lasers import ScanShape
from stillmap.io.ros.messages import frame_name, stamp_ns
from stillmap.live.ros.inputs import Mount, Parameters, to_scan_beams
from stillmap.live.scan import ScanBeams

if TYPE_CHECKING:
    from stillmap.live.ros.transforms import Transforms


NO_STAMP = "scan without a stamp"
BACKWARDS = "stamp before that of an earlier scan"
REPEATED = "stamp of the scan before"
AHEAD = "stamp far ahead of the scan before"
EARLY = "scan before the first odometry"
NO_MOUNT = "no transform from the robot to the laser"
OVERFLOW = "more scans than can wait"
NO_ODOMETRY = "scan without odometry"
SET_BACK = "clock set back"

_FIRST_ODOMETRY = 2.0  # s for which the first scan waits for odometry
_SILENCE = 1.0  # s after which nobody waits for a laser any more
_LEAP_NS = 5 * 10**9  # by which a stamp leaps that is farther ahead, or behind
_LEAPS_FOR = 2.0  # s in which the stamps of all scans leap


@dataclass(frozen=True, eq=False)
class Arrival(ShortRepr):
    """A scan that can be mapped.

    Attributes:
        topic: where it came from.
        message: the LaserScan or PointCloud2.
        beams: of the scan.
        T_odom_base: (D+1, D+1), or None: not known.
        arrived: s of a steady clock.
    """

    topic: str
    message: Any
    beams: ScanBeams
    T_odom_base: Float | None
    arrived: float


class _Waiting(NamedTuple):
    stamp_ns: int
    topic: str
    message: Any
    arrived: float


@dataclass
class _Laser:
    """State of one scan topic: newest stamp, its arrival, number of scans."""

    newest_ns: int
    arrived: float
    count: int = 0


class ScanIntake:
    """Puts scans of several lasers in order, and finds mounts and odometry for them.

    Args:
        parameters: see Parameters.
        transforms: of the robot.

    Attributes:
        counts: scans that were left out, by the reason.
        set_back: s by which the clock of all scans was set back for good; 0: it was not.
        waiting: scans that are to be tried again after a while, the first one first.
    """

    def __init__(self, parameters: Parameters, transforms: "Transforms") -> None:
        self._parameters, self._transforms = parameters, transforms
        self.counts = Counter[str]()
        self._mounts: dict[tuple[str, str], Mount] = {}
        self._begin()

    def _begin(self) -> None:
        self._lasers: dict[str, _Laser] = {}
        self.waiting: list[_Waiting] = []
        self._last_ns, self._last_topics = 0, set[str]()  # of the last scan that was mapped
        self._first_arrived: float | None = None
        self._silent_ns = -1  # the last odometry when a scan waited for it in vain
        self._leaps_since: float | None = None
        self.set_back = 0.0

    def begin_anew(self) -> None:
        """Forget scans, odometry and transforms that are not static: time has begun anew."""
        self._begin()
        self._transforms.forget()

    def add_scan(self, topic: str, message: Any, now: float) -> None:
        """Add a LaserScan or PointCloud2 that arrived now, in seconds of a steady clock."""
        stamp = stamp_ns(message.header)
        fault = self._find_damage(message) or (None if stamp > 0 else NO_STAMP)
        if fault is None:
            fault = self._check_clock(topic, stamp, now)
        if fault is not None:
            self.counts[fault] += 1
            return
        laser = self._lasers[topic]
        laser.count += 1
        if (laser.count - 1) % self._parameters.throttle_scans:
            return
        if self._first_arrived is None:
            self._first_arrived = now
        waiting = _Waiting(stamp, topic, message, now)
        insort(self.waiting, waiting, key=lambda scan: scan.stamp_ns)
        if len(self.waiting) > self._parameters.scan_queue_size:
            self.waiting.pop(0)
            self.counts[OVERFLOW] += 1

    def take(self, now: float) -> Arrival | None:
        """The next scan that can be mapped, or that has waited long enough; None: there is none."""
        while self.waiting:
            first = self.waiting[0]
            has_waited = now - first.arrived >= self._parameters.transform_timeout
            mount = self._find_mount(first)
            pose = self._transforms.odometry_at(first.stamp_ns)
            fault = NO_MOUNT if mount is None and has_waited else self._find_fault(first, pose)
            if fault is not None:
                self.waiting.pop(0)
                self.counts[fault] += 1
                continue
            if mount is None or self._must_wait(first, pose, now, has_waited):
                return None
            return self._release(mount, pose)
        return None

    def _find_damage(self, message: Any) -> str | None:
        if self._parameters.dimension == 2:
            return ScanShape.of(message, len(message.ranges)).find_fault()
        layout = find_layout(message)
        return layout if isinstance(layout, str) else None

    def _find_mount(self, scan: _Waiting) -> Mount | None:
        key = scan.topic, frame_name(scan.message.header.frame_id)
        if key not in self._mounts:
            mount = self._transforms.find_mount(*key, scan.stamp_ns)
            if mount is None:
                return None
            self._mounts[key] = mount
        return self._mounts[key]

    def _check_clock(self, topic: str, stamp: int, now: float) -> str | None:
        """Why a stamp is not believed: one alone that leaps means nothing, but a while in which
        there are no others does. Ahead they are used then, before the last scan never."""
        laser = self._lasers.setdefault(topic, _Laser(stamp, now))
        elapsed = round(1e9 * (now - laser.arrived))
        is_ahead = stamp > laser.newest_ns + elapsed + _LEAP_NS
        is_behind = stamp < self._last_ns - _LEAP_NS
        if not (is_ahead or is_behind):
            self._leaps_since, self.set_back = None, 0.0
        elif self._leaps_since is None:
            self._leaps_since = now
        lasts = self._leaps_since is not None and now - self._leaps_since > _LEAPS_FOR
        if is_behind and lasts:
            self.counts[SET_BACK] += self.set_back == 0.0
            self.set_back = 1e-9 * (self._last_ns - stamp)
        if is_ahead and not lasts:
            return AHEAD
        laser.newest_ns, laser.arrived = max(laser.newest_ns, stamp), now
        return None

    def _find_fault(self, scan: _Waiting, pose: Float | None) -> str | None:
        """Why a scan cannot be mapped after those that were."""
        if scan.stamp_ns < self._last_ns:
            return BACKWARDS
        if scan.stamp_ns == self._last_ns and scan.topic in self._last_topics:
            return REPEATED
        is_first = not self._last_topics and self._parameters.odom_frame
        if is_first and pose is None and self._transforms.last_odometry_ns > scan.stamp_ns:
            return EARLY
        return None

    def _must_wait(self, scan: _Waiting, pose: Float | None, now: float, has_waited: bool) -> bool:
        # another laser may still have something earlier
        if not has_waited and not all(
            laser.newest_ns >= scan.stamp_ns or now - laser.arrived > _SILENCE
            for laser in self._lasers.values()
        ):
            return True
        if pose is not None or not self._parameters.odom_frame:
            return False
        if self._transforms.source is None:  # the robot has just been switched on
            assert self._first_arrived is not None
            return now - self._first_arrived < _FIRST_ODOMETRY
        # odometry that failed once is not waited for until it comes again
        return self._silent_ns != self._transforms.last_odometry_ns and not has_waited

    def _release(self, mount: Mount, pose: Float | None) -> Arrival:
        scan = self.waiting.pop(0)
        if scan.stamp_ns > self._last_ns:
            self._last_ns, self._last_topics = scan.stamp_ns, set()
        self._last_topics.add(scan.topic)
        if pose is None and self._parameters.odom_frame:
            self.counts[NO_ODOMETRY] += 1
            self._silent_ns = self._transforms.last_odometry_ns
        beams = to_scan_beams(scan.message, scan.topic, mount, self._parameters)
        return Arrival(scan.topic, scan.message, beams, pose, scan.arrived)
