"""Inputs of the mesh room: a posed and labelled 3D recording, its moving objects, and the upright
boxes along their tracks, which occlude what is behind them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Bool, Float, Float32, Index
from stillmap.core.camera import Images
from stillmap.core.recording import Recording, max_scan_duration_ns
from stillmap.core.segments import segments_meet_box
from stillmap.em import GroundMap
from stillmap.mesh.range_image import has_planar_scans
from stillmap.tracking import MovingObject
from stillmap.tracking.boxes import MAX_OBJECT_HEIGHT, MIN_VEHICLE_LENGTH, Box, fit_box

OUTLINE_MARGIN = 0.05  # m around the observed extent of an object
_OUTLINE_SIGMA = 0.05  # m, standard deviation of its outline beyond that margin
_GROWTHS = (0.0, 1.0, 2.0, 3.0)  # sigmas beyond the margin at which occlusion is evaluated
_P_IN_BOX = 0.99  # probability that an object is where its box is
_MIN_RIGID_SIZE = 1.2  # m: objects at least so long or wide are no people
_MIN_RIGID_SPEED = 2.0  # m/s: faster objects are no people
_SPEED_QUANTILE = 0.9  # of an object's speeds that counts


class TrackedBox(NamedTuple):
    """An upright box that moves along the track of an object.

    Attributes:
        box: its footprint over time.
        bottom: (L,) metres, height of its lower side in the map frame at the times of `box`.
        height: metres.
    """

    box: Box
    bottom: Float
    height: float

    def pose_at(self, seconds: Float) -> tuple[Float, Float, Float]:
        """Center (n, 2) metres, heading (n, 2) and height of the lower side (n,) at times (n,)."""
        box = self.box
        at = np.clip(np.searchsorted(box.seconds, seconds, side="right") - 1, 0, None)
        bottom = np.interp(seconds, box.seconds, self.bottom)
        return box.center_at(seconds), box.heading[at], bottom

    def motion_until(self, now: float, seconds: Float) -> Float:
        """(n, 2) metres by which the box moves from times (n,) to a time."""
        return self.box.center_at(np.array([now])) - self.box.center_at(seconds)

    @property
    def is_fast(self) -> bool:
        """True if the speed of the object exceeds that of a pedestrian."""
        speed = np.linalg.norm(self.box.velocity, axis=1)
        return bool(np.quantile(speed, _SPEED_QUANTILE) > _MIN_RIGID_SPEED)

    @property
    def is_large(self) -> bool:
        """True if the footprint of the object is longer than that of a pedestrian."""
        return 2.0 * max(self.box.half_size) >= _MIN_RIGID_SIZE


def box_objects(objects: Sequence[MovingObject], start_ns: int) -> list[TrackedBox]:
    """Boxes along the tracks of objects of a 3D recording."""
    boxes = []
    for one in objects:
        assert one.z is not None
        height = float(one.size[2])
        boxes.append(TrackedBox(fit_box(one, start_ns), one.z - 0.5 * height, height))
    return boxes


def extrude_boxes(
    boxes: Sequence[Box], objects: Sequence[MovingObject], ground: GroundMap
) -> list[TrackedBox]:
    """Planar boxes of a flat laser with the heights that a second laser measured.

    Args:
        boxes: planar boxes.
        objects: moving objects with heights, of the second laser.
        ground: ground height below the boxes.
    """
    heights = {one.id: float(one.size[2]) for one in objects}
    out = []
    for box in boxes:
        is_vehicle = 2.0 * max(box.half_size) >= MIN_VEHICLE_LENGTH
        min_height = 0.0 if is_vehicle else MAX_OBJECT_HEIGHT
        height = max(heights.get(box.object_id, 0.0), min_height)
        out.append(TrackedBox(box, ground.height_at(box.xy), height))
    return out


class ObjectFrame(NamedTuple):
    """Pose of an object's frame over time: that of its track, with corrections.

    Attributes:
        box: box along the track.
        seconds: (S,) times of the corrections, rising; S > 0.
        offset: (S, 3) corrections of points in the frame of the track: metres ahead and to the
            left, rad to the left.
    """

    box: TrackedBox
    seconds: Float
    offset: Float

    @classmethod
    def from_track(cls, box: TrackedBox) -> "ObjectFrame":
        """The frame of the track, uncorrected."""
        return cls(box, box.box.seconds[:1], np.zeros((1, 3)))

    def to_object(self, seconds: Float, points: Float) -> Float:
        """(n, 3) metres in the object's frame, of map points (n, 3) at times (n,)."""
        center, heading, bottom = self.box.pose_at(seconds)
        ahead, left = se2.along_and_across(points[:, :2] - center, heading)
        dx, dy, turn = (np.interp(seconds, self.seconds, column) for column in self.offset.T)
        c, s = np.cos(turn), np.sin(turn)
        x, y = c * ahead - s * left + dx, s * ahead + c * left + dy
        return np.stack([x, y, points[:, 2] - bottom], axis=1)

    def T_map_object(self, seconds: float) -> Float:
        """(4, 4) pose of the object's frame at a time."""
        corners = np.vstack([np.zeros(3), np.eye(3)])
        at = self.to_object(np.full(4, seconds), corners)
        T_object_map = np.eye(4)
        T_object_map[:3, :3] = (at[1:] - at[0]).T
        T_object_map[:3, 3] = at[0]
        return np.asarray(np.linalg.inv(T_object_map))


class OrientedBox(NamedTuple):
    """An upright box at one time.

    Attributes:
        center: (3,) metres in the map frame.
        heading: (2,) unit vector to the front.
        half_size: (3,) metres to the front, to the side, upwards.
    """

    center: Float
    heading: Float
    half_size: Float

    def local(self, points: Float) -> Float:
        """(n, 3) metres ahead, to the left and above the center, of map points (n, 3)."""
        off = points - self.center
        ahead, left = se2.along_and_across(off[:, :2], self.heading)
        return np.stack([ahead, left, off[:, 2]], axis=1)


def boxes_at(boxes: Sequence[TrackedBox], seconds: float) -> list[OrientedBox]:
    """The boxes that exist at a time, in seconds of their tracks."""
    out = []
    for tracked in boxes:
        box, half_height = tracked.box, 0.5 * tracked.height
        if max(box.seconds[0] - seconds, seconds - box.seconds[-1]) <= box.hold:
            (xy,), (heading,), (low,) = tracked.pose_at(np.array([seconds]))
            center, half_size = [*xy, low + half_height], [*box.half_size, half_height]
            out.append(OrientedBox(np.array(center), heading, np.array(half_size)))
    return out


def occlusion_probability(boxes: Sequence[OrientedBox], position: Float, points: Float) -> Float:
    """(n,) probability that a box blocks the line of sight from a camera to each point.

    Within `OUTLINE_MARGIN` of a box it is nearly 1; farther out it falls like a normal
    distribution.

    Args:
        boxes: at the time of the image.
        position: (3,) metres, camera center.
        points: (n, 3) metres.
    """
    free = np.ones(len(points))
    reach = 2.0 * (OUTLINE_MARGIN + _GROWTHS[-1] * _OUTLINE_SIGMA)
    for one, near, start, ends in _sights_near_boxes(boxes, position, points, reach):
        shown = np.zeros(len(near))
        for growth in reversed(_GROWTHS):
            half_size = one.half_size + OUTLINE_MARGIN + growth * _OUTLINE_SIGMA
            shown[segments_meet_box(start, ends, half_size)] = _P_IN_BOX * np.exp(-0.5 * growth**2)
        free[near] *= 1.0 - shown
    return 1.0 - free


def is_in_or_behind_box(boxes: Sequence[OrientedBox], position: Float, points: Float) -> Bool:
    """(n,) whether the line of sight from a camera (3,) to points (n, 3) meets a box."""
    out = np.zeros(len(points), np.bool_)
    for one, near, start, ends in _sights_near_boxes(boxes, position, points, 0.0):
        out[near] |= segments_meet_box(start, ends, one.half_size)
    return out


def _sights_near_boxes(
    boxes: Sequence[OrientedBox], position: Float, points: Float, reach: float
) -> Iterator[tuple[OrientedBox, Index, Float, Float]]:
    """Boxes, the numbers of the points (k,) to which the line of sight passes within `reach` metres
    of the sphere around the box, and both ends (3,), (k, 3) of these lines in its frame."""
    along = np.ascontiguousarray((points - position).T)
    square = np.maximum(along[0] ** 2 + along[1] ** 2 + along[2] ** 2, 1e-12)
    for one in boxes:
        distance = squared_segment_distances(one.center - position, along, square)
        near = np.flatnonzero(distance <= (float(np.linalg.norm(one.half_size)) + reach) ** 2)
        if len(near):
            yield one, near, one.local(position[None])[0], one.local(points[near])


def squared_segment_distances(center: Float, along: Float, square: Float) -> Float:
    """(n,) squared distances from a point (3,) to segments from the origin to `along` (3, n).

    `square` (n,) are their squared lengths.
    """
    dot = center[0] * along[0] + center[1] * along[1] + center[2] * along[2]
    share = np.clip(dot / square, 0.0, 1.0)
    return np.asarray(center @ center + share * (share * square - 2.0 * dot))


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

    def beams_within(self, first: float, last: float) -> tuple[Index, Float]:
        """The beams (n,) between two times, and their times (n,)."""
        scans, offset = self.scans_within(first, last), self.deskewed.offset
        beams = np.arange(offset[scans.start], offset[scans.stop])
        seconds = self.seconds_of(beams)
        within = (seconds >= first) & (seconds <= last)
        return beams[within], seconds[within]

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
