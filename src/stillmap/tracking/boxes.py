"""Boxes in the plane around what a flat laser sees to move, at any time."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.core.recording import Recording
from stillmap.tracking import MovingObject, ObjectOptions
from stillmap.tracking.clustering import extract_dynamic_points

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

_WALKS = 0.3  # m/s from where on a thing's velocity says where its front is
_FEWEST = 2  # end points of something that is in no track: fewer are noise
_MOMENT = 0.1  # s for which these stand where they were seen


@dataclass(frozen=True, eq=False)
class Box:
    """A rectangle that goes along with a thing.

    Attributes:
        thing: number of the object; -1: it was seen too shortly to be one.
        seconds: (L,) when it was seen, rising.
        xy: (L, 2) metres, its middle in the map frame.
        ahead: (L, 2) of length one, where its front is.
        velocity: (L, 2) metres per second.
        half: metres to the front and to the side, half its size.
        hold: s before it was first seen, and after it was last, for which it goes on evenly.
    """

    object_id: int
    seconds: Float
    xy: Float
    heading: Float
    velocity: Float
    half_size: tuple[float, float]
    hold: float

    def center_at(self, seconds: Float) -> Float:
        """(n, 2) metres, where its middle is at times (n,); beyond its ends it goes on evenly."""
        early = np.minimum(seconds - self.seconds[0], 0.0)
        late = np.maximum(seconds - self.seconds[-1], 0.0)
        middle = np.stack([np.interp(seconds, self.seconds, c) for c in self.xy.T], axis=1)
        middle += early[:, None] * self.velocity[0] + late[:, None] * self.velocity[-1]
        return middle

    def contains(self, seconds: Float, xy: Float, margin: float) -> Bool:
        """(n,) whether places (n, 2) lie in it, or within `margin` metres, at times (n,)."""
        early = np.minimum(seconds - self.seconds[0], 0.0)
        late = np.maximum(seconds - self.seconds[-1], 0.0)
        middle = self.center_at(seconds)
        at = np.clip(np.searchsorted(self.seconds, seconds, side="right") - 1, 0, None)
        ahead, off = self.heading[at], xy - middle
        along = np.abs((off * ahead).sum(axis=1))
        across = np.abs(off[:, 1] * ahead[:, 0] - off[:, 0] * ahead[:, 1])
        near = (along <= self.half_size[0] + margin) & (across <= self.half_size[1] + margin)
        return np.asarray(near & (late - early <= self.hold))


def fit_boxes(
    recording: Recording,
    poses: Float,
    p_static: NDArray[np.float32],
    objects: Sequence[MovingObject],
    options: ObjectOptions,
    hold: float,
) -> list[Box]:
    """Boxes around all beams that are dynamic as probably as `options.dynamic`.

    Args:
        recording: 2D, M beams, without motion during its scans.
        poses: (T, 3, 3) T_map_base.
        p_static: (M,) P(c = 1) of every beam.
        objects: what moved.
        options: see ObjectOptions.
        hold: s for which an object goes on before it was first seen, and after it was last.
    """
    start = int(recording.stamp_ns[0])
    return [fit_box(one, start, hold) for one in objects] + _of_others(
        recording, poses, p_static, objects, options
    )


def fit_box(one: MovingObject, start: int, hold: float) -> Box:
    """The box of an object; its time begins at `start` ns, and it goes on for `hold` s."""
    seconds = np.asarray(1e-9 * (one.stamp_ns - start), np.float64)
    speed = np.linalg.norm(one.velocity, axis=1)
    walks = np.flatnonzero(speed > _WALKS)
    half = (0.5 * one.size[0], 0.5 * one.size[1])
    if not len(walks):  # nobody knows where its front is
        ahead = np.tile([1.0, 0.0], (len(seconds), 1))
        return Box(one.id, seconds, one.xy, ahead, one.velocity, (max(half), max(half)), hold)
    # who stands looks where he went
    at = walks[np.clip(np.searchsorted(walks, np.arange(len(speed)), "right") - 1, 0, None)]
    return Box(
        one.id, seconds, one.xy, one.velocity[at] / speed[at, None], one.velocity, half, hold
    )


def _of_others(
    recording: Recording,
    poses: Float,
    p_static: NDArray[np.float32],
    objects: Sequence[MovingObject],
    options: ObjectOptions,
) -> list[Box]:
    """Of neighbours in a scan that move and are of no object."""
    points = extract_dynamic_points(recording, poses, p_static, options)
    owned = np.concatenate([np.zeros(0, np.intp), *(one.beams for one in objects)])
    rest = ~np.isin(points.beam, owned)
    xy, scan = points.xy[rest], points.scan[rest]
    _, first, count = np.unique(points.cluster[rest], return_index=True, return_counts=True)
    out = []
    for a, n in zip(first.tolist(), count.tolist(), strict=True):
        if n < _FEWEST:
            continue
        low, high = xy[a : a + n].min(axis=0), xy[a : a + n].max(axis=0)
        half = 0.5 * (high - low)
        out.append(
            Box(
                -1,
                1e-9 * (recording.stamp_ns[scan[a : a + 1]] - recording.stamp_ns[0]),
                0.5 * (low + high)[None],
                np.array([[1.0, 0.0]]),
                np.zeros((1, 2)),
                (float(half[0]), float(half[1])),
                _MOMENT,
            )
        )
    return out
