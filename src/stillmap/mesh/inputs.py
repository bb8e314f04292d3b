"""Inputs of the mesh room: a posed and labelled 3D recording and its moving objects."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from stillmap.core.array_types import Bool, Float, Float32, Index
from stillmap.core.camera import Images
from stillmap.core.recording import Recording, max_scan_duration_ns
from stillmap.mesh.range_image import has_planar_scans
from stillmap.mesh.tracked_boxes import TrackedBox
from stillmap.tracking import MovingObject

_SCANS_AROUND = 1  # before and after a time, whose beams may be of it
_WINDOW = 0.06  # s around an image: longer, and untracked movers smear
_WINDOW_TILTING = 0.15  # s, for planar scans: each row is only a line across the image
_WINDOW_TRACKED = 0.5  # s, for planar scans of tracked objects, motion-compensated
_CLOCK_ERROR = 1e-9  # s
_NO_IMAGES = Images(np.zeros(0, np.int64), np.zeros(0, np.int32), (), np.zeros)


@dataclass(frozen=True, eq=False)
class MeshInputs:
    """A 3D recording of T scans and M beams with poses, labels and moving objects.

    Attributes:
        recording: as it was read, with its times and images.
        deskewed: the same, deskewed.
        poses: (T, 4, 4) T_map_base.
        p_static: (M,) P(c = 1).
        objects: moving objects with their beams.
        boxes: boxes along their tracks, and boxes of detections too short for a track.
        start_ns: stamp at which the seconds of these boxes begin.
    """

    recording: Recording
    deskewed: Recording
    poses: Float
    p_static: Float32
    objects: Sequence[MovingObject]
    boxes: Sequence[TrackedBox]
    start_ns: int

    @property
    def images(self) -> Images:
        """The images of the recording; there may be none."""
        return self.recording.images or _NO_IMAGES

    @cached_property
    def is_planar(self) -> bool:
        """True if most scans are planar, as those of a tilting laser."""
        return has_planar_scans(self.deskewed)

    @cached_property
    def max_scan_ns(self) -> int:
        """Approximate maximum duration of a scan in nanoseconds."""
        return max_scan_duration_ns(self.recording)

    @cached_property
    def T_map_sensor(self) -> Float:
        """(T, 4, 4)."""
        return self.deskewed.T_map_sensor(self.poses)

    def seconds_of(self, beams: Index) -> Float:
        """(n,) times of beams (n,), rising, by the clock of boxes."""
        recording = self.recording
        times = recording.stamp_ns[recording.scans_of(beams)]
        if recording.beam_time is not None:
            since = np.round(1e9 * recording.beam_time[beams].astype(np.float64))
            times = times + since.astype(int)
        return np.asarray(1e-9 * (times - self.start_ns), np.float64)

    def scans_within(self, first: float, last: float) -> slice:
        """Scans that may have beams between two times, and some around."""
        stamps = 1e-9 * (self.deskewed.stamp_ns - self.start_ns)
        slack = 1e-9 * self.max_scan_ns
        a = int(np.searchsorted(stamps, first - slack)) - _SCANS_AROUND
        b = int(np.searchsorted(stamps, last + slack, side="right")) + _SCANS_AROUND
        return slice(max(a, 0), min(b, len(stamps)))

    @cached_property
    def _beams_of_boxes(self) -> list[tuple[TrackedBox, Index]]:
        """Boxes with the beams of their objects."""
        beams = {one.id: one.beams for one in self.objects}
        return [(one, beams[one.box.object_id]) for one in self.boxes if one.box.object_id in beams]

    @cached_property
    def _on_dynamic_object(self) -> Bool:
        """(M,) whether a beam ended on an object and is rather dynamic."""
        out = np.zeros(len(self.p_static), np.bool_)
        for _, owned in self._beams_of_boxes:
            out[owned] = self.p_static[owned] < 0.5
        return out

    def returns_near(self, stamp_ns: int) -> tuple[Float, Float32]:
        """Returns near a time; those on tracked objects moved along their track to that time.

        Returns:
            (n, 3) metres in the map frame, and P(static) (n,).
        """
        window = _WINDOW_TILTING if self.is_planar else _WINDOW
        tracked = _WINDOW_TRACKED if self.is_planar else window
        now = 1e-9 * (stamp_ns - self.start_ns)
        scans = self.scans_within(now - tracked, now + tracked)
        beams = np.arange(self.deskewed.offset[scans.start], self.deskewed.offset[scans.stop])
        away = np.abs(self.seconds_of(beams) - now)
        # at least the nearest, as scans without per-beam times share one stamp
        near = away <= max(window, float(away.min(initial=np.inf))) + _CLOCK_ERROR
        if self.is_planar:
            near |= (away <= tracked) & self._on_dynamic_object[beams]
        beams = beams[self.deskewed.hit[beams] & near]
        ends = self.deskewed.end_points(beams, self.poses)
        for box, owned in self._beams_of_boxes if len(beams) else ():
            first, last = np.searchsorted(owned, beams[[0, -1]])
            mine = np.flatnonzero(np.isin(beams, owned[first : last + 1]))
            ends[mine, :2] += box.motion_until(now, self.seconds_of(beams[mine]))
        return ends, self.p_static[beams]
