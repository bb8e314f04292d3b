"""What stands apart from all else moves as a whole, or stands still. See `docs/space.md`."""

import numpy as np
from numpy.typing import NDArray

from stillmap import _core
from stillmap.em.chunks import chunks
from stillmap.em.ground import Ground
from stillmap.em.looks import Float, Surface, blocks_of
from stillmap.em.options import BodyOptions
from stillmap.recording.model import Recording

_STATIC = 0.5  # probability from which on an element is called static


def with_bodies(
    p_static: NDArray[np.float32],
    change: NDArray[np.float32],
    surface: Surface,
    ground: Ground,
    recording: Recording,
    T_map_sensor: Float,
    options: BodyOptions,
    threads: int = 1,
) -> NDArray[np.float32]:
    """(E,) P(static), lowered for static elements of bodies that move, or came or left.

    Args:
        p_static: (E,) by what is known of each element and of those right beside it.
        change: (E,) nats by which the looks at it say that a thing came or left; see `Told`.
        surface: the elements, in space.
        ground: how high it is; where none was seen nobody knows what stands on it.
        recording: 3D, M beams without motion during its scans.
        T_map_sensor: (T, 4, 4).
        options: see BodyOptions.
        threads: same result with any number.
    """
    if not (options.enabled and ground.seen):
        return p_static
    if not isinstance(surface, _core.Surface3D):
        raise TypeError("surface: expected one in space")
    column = max(1, round(options.column / surface.resolution))
    stands = above_ground(surface, ground, options.low, options.high)
    values = np.stack([1.0 - p_static, change], axis=1)
    bodies = _core.Bodies3D(surface, stands, values, column=column, fewest=options.fewest)
    for scans, beams, offset in chunks(recording):
        points, hit = recording.points[beams], recording.hit[beams]
        bodies.add(points, hit, offset, T_map_sensor[scans], threads)
    return lowered(p_static, bodies.means(), options)


def above_ground(surface: Surface, ground: Ground, low: float, high: float) -> NDArray[np.bool_]:
    """(E,) whether an element's mean is between two heights (m) above the ground."""
    stands = np.empty(surface.size, np.bool_)
    for rows in blocks_of(surface):
        means = surface.elements(rows)[1]
        above = means[:, 2] - ground.at(means[:, :2])
        stands[slice(*rows)] = (above > low) & (above < high)
    return stands


def lowered(
    p_static: NDArray[np.float32], means: NDArray[np.float32], options: BodyOptions
) -> NDArray[np.float32]:
    """(E,) lowered to log odds of slope (least - mean), -most at least, where that is negative.

    Args:
        p_static: (E,).
        means: (E, 2) of the bodies around each: probability to move, nats for a change; NaN: of
            none.
        options: `share` and `change` are the least values of these that tell.
    """
    above = np.nan_to_num(means - np.array([options.share, options.change], np.float32), nan=-1.0)
    nats = np.minimum(options.slope * above.max(axis=1), options.most)
    of = np.flatnonzero((p_static >= _STATIC) & (nats > 0.0))
    out = p_static.copy()
    out[of] = np.minimum(out[of], 1.0 / (1.0 + np.exp(nats[of])))
    return out
