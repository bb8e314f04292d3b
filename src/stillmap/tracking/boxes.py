"""Boxes in the plane around moving objects, at any time."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Bool, Float, Float32
from stillmap.core.recording import Recording
from stillmap.tracking import MovingObject
from stillmap.tracking.clustering import MIN_P_DYNAMIC, extract_dynamic_points
from stillmap.tracking.objects import HEADING_SPEED

HOLD = 0.5  # s for which an object persists before its first and after its last detection
MAX_OBJECT_HEIGHT = 2.0  # m above the ground
MIN_VEHICLE_LENGTH = 1.5  # m; objects of this length may be higher
_MIN_POINTS = 2  # end points of a cluster without a track: fewer are noise
_CLUSTER_HOLD = 0.1  # s for which the box of such a cluster persists


@dataclass(frozen=True, eq=False)
class Box:
    """A rectangle that moves with an object.

    Attributes:
        object_id: id of the object; -1: a cluster without a track.
        seconds: (L,) times of the detections, rising.
        xy: (L, 2) metres, center in the map frame.
        heading: (L, 2) unit vectors to the front.
        velocity: (L, 2) metres per second.
        half_size: metres from the center to the front and to the side.
        hold: s for which the box persists before its first and after its last detection.
    """

    object_id: int
    seconds: Float
    xy: Float
    heading: Float
    velocity: Float
    half_size: tuple[float, float]
    hold: float

    def center_at(self, seconds: Float) -> Float:
        """(n, 2) metres, center at times (n,), extrapolated at constant velocity."""
        early, late = self._outside(seconds)
        center = np.stack([np.interp(seconds, self.seconds, c) for c in self.xy.T], axis=1)
        center += early[:, None] * self.velocity[0] + late[:, None] * self.velocity[-1]
        return center

    def _outside(self, seconds: Float) -> tuple[Float, Float]:
        """Seconds before the first detection, negative, and after the last one; else 0."""
        early = np.minimum(seconds - self.seconds[0], 0.0)
        return early, np.maximum(seconds - self.seconds[-1], 0.0)

    def contains(self, seconds: Float, xy: Float, margin: float) -> Bool:
        """(n,) whether positions (n, 2) at times (n,) lie within `margin` metres of the box."""
        early, late = self._outside(seconds)
        at = np.clip(np.searchsorted(self.seconds, seconds, side="right") - 1, 0, None)
        along, across = se2.along_and_across(xy - self.center_at(seconds), self.heading[at])
        near = np.abs(along) <= self.half_size[0] + margin
        near &= np.abs(across) <= self.half_size[1] + margin
        return np.asarray(near & (late - early <= self.hold))


def fit_boxes(
    recording: Recording, poses: Float, p_static: Float32, objects: Sequence[MovingObject]
) -> list[Box]:
    """Boxes around all beams that may belong to a moving object, which persists for `HOLD`.

    Args:
        recording: 2D, M beams, deskewed.
        poses: (T, 3, 3) T_map_base.
        p_static: (M,) P(c = 1) of every beam.
        objects: the moving objects.
    """
    start = int(recording.stamp_ns[0])
    points = extract_dynamic_points(recording, poses, p_static, MIN_P_DYNAMIC)
    owned = np.concatenate([np.zeros(0, np.intp), *(mover.beams for mover in objects)])
    rest = ~np.isin(points.beam, owned)
    xy, scan = points.xy[rest], points.scan[rest]
    out = [fit_box(mover, start) for mover in objects]
    _, first, count = np.unique(points.cluster[rest], return_index=True, return_counts=True)
    for a, n in zip(first.tolist(), count.tolist(), strict=True):
        if n >= _MIN_POINTS:
            seconds = 1e-9 * (recording.stamp_ns[scan[a : a + 1]] - recording.stamp_ns[0])
            out.append(_fit_static_box(xy[a : a + n], seconds))
    return out


def fit_box(mover: MovingObject, start: int) -> Box:
    """The box of an object.

    Args:
        mover: the object.
        start: ns, time 0 of the box.
    """
    seconds = np.asarray(1e-9 * (mover.stamp_ns - start), np.float64)
    speed = np.linalg.norm(mover.velocity, axis=1)
    moving = np.flatnonzero(speed > HEADING_SPEED)
    half = (0.5 * mover.size[0], 0.5 * mover.size[1])
    if len(moving):  # at rest it keeps the heading of its last motion
        at = moving[np.clip(np.searchsorted(moving, np.arange(len(speed)), "right") - 1, 0, None)]
        heading = mover.velocity[at] / speed[at, None]
    else:  # its heading is unknown
        heading, half = np.tile([1.0, 0.0], (len(seconds), 1)), (max(half), max(half))
    return Box(mover.id, seconds, mover.xy, heading, mover.velocity, half, HOLD)


def _fit_static_box(xy: Float, seconds: Float) -> Box:
    """The box at rest around the points (n, 2) of a cluster at one time (1,)."""
    low, high = xy.min(axis=0), xy.max(axis=0)
    half = 0.5 * (high - low)
    return Box(
        object_id=-1,
        seconds=seconds,
        xy=0.5 * (low + high)[None],
        heading=np.array([[1.0, 0.0]]),
        velocity=np.zeros((1, 2)),
        half_size=(float(half[0]), float(half[1])),
        hold=_CLUSTER_HOLD,
    )
