"""The beams that were taken about when a picture was, and where they would have ended then."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from stillmap.recording.model import Recording
from stillmap.recording.stamps import beam_ns, longest_scan_ns
from stillmap.scene.boxes import Box
from stillmap.texture.choice_options import ChoiceOptions

Float = NDArray[np.float64]
Index = NDArray[np.intp]

_NEVER = np.iinfo(np.int64).max


@dataclass(frozen=True, eq=False)
class Beams:
    """T scans with M beams of a recording in 3D, to be asked for by time.

    Attributes:
        recording: as it was read; its times count.
        seen: without the motion during its scans; its points count.
        T_map_sensor: (T, 4, 4).
        p_static: (M,) P(c = 1).
        boxes: of things that move, their times in seconds after `start_ns`.
        owned: for each of these the beams (n,) that ended on it, rising.
        start_ns: when the time of the boxes begins.
        planar: whether scans lie in a plane, so that each sees only a line of what is there.
    """

    recording: Recording
    seen: Recording
    T_map_sensor: Float
    p_static: NDArray[np.float32]
    boxes: Sequence[Box]
    owned: Sequence[Index]
    start_ns: int
    planar: bool = False

    @cached_property
    def _moving(self) -> NDArray[np.bool_]:
        """(M,) whether a beam ended on one of the things, and rather moves."""
        out = np.zeros(len(self.p_static), np.bool_)
        for owned in self.owned:
            out[owned] = self.p_static[owned] < 0.5
        return out

    def about(self, stamp_ns: int, options: ChoiceOptions) -> tuple[Float, NDArray[np.float32]]:
        """Where hits ended about a time, had things that move been where they are then.

        Those within `options.window` seconds; of planar scans those within `options.rows`, and
        what ended on a thing that is followed within `options.carried`.

        Returns:
            (n, 3) metres in the map frame, and P(static) (n,).
        """
        window = options.rows if self.planar else options.window
        carried = max(options.carried, window) if self.planar else window
        scans = self._scans(stamp_ns, carried)
        if scans.stop <= scans.start:
            return np.zeros((0, 3)), np.zeros(0, np.float32)
        first, last = self.seen.offset[[scans.start, scans.stop]]
        at_ns = beam_ns(self.recording, scans)
        apart = np.abs(at_ns - stamp_ns)
        # at least what is nearest, as where scans count as taken at once
        near = apart <= max(int(1e9 * window), int(apart.min(initial=_NEVER)))
        if carried > window:
            near |= (apart <= int(1e9 * carried)) & self._moving[first:last]
        kept = np.flatnonzero(self.seen.hit[first:last] & near)
        beams = int(first) + kept
        ends = np.empty((len(beams), 3))
        bounds = np.searchsorted(beams, self.seen.offset[scans.start : scans.stop + 1])
        for scan, (low, high) in zip(range(scans.start, scans.stop), pairwise(bounds), strict=True):
            T = self.T_map_sensor[scan]
            ends[low:high] = self.seen.points[beams[low:high]] @ T[:3, :3].T + T[:3, 3]
        self._go_on(ends, beams, at_ns[kept], stamp_ns)
        return ends, self.p_static[beams]

    def _scans(self, stamp_ns: int, window: float) -> slice:
        """Those of which some beam may have been taken then; at least the nearest."""
        stamps = self.recording.stamp_ns
        reach = 1e9 * window + self._longest
        first = int(np.searchsorted(stamps, stamp_ns - reach))
        last = int(np.searchsorted(stamps, stamp_ns + reach, side="right"))
        return slice(first, last)

    @cached_property
    def _longest(self) -> int:
        """Nanoseconds that a scan takes at most, about."""
        return longest_scan_ns(self.recording)

    def _go_on(self, ends: Float, beams: Index, at_ns: NDArray[np.int64], stamp_ns: int) -> None:
        for box, owned in zip(self.boxes, self.owned, strict=True):
            if not len(owned) or not len(beams) or owned[-1] < beams[0] or owned[0] > beams[-1]:
                continue
            place = np.searchsorted(owned, beams)
            mine = np.flatnonzero(owned[np.minimum(place, len(owned) - 1)] == beams)
            if not len(mine):
                continue
            then = box.middle(np.asarray(1e-9 * (at_ns[mine] - self.start_ns), np.float64))
            now = box.middle(np.array([1e-9 * (stamp_ns - self.start_ns)]))
            ends[mine, :2] += now - then
