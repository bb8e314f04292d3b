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
    surface: Surface,
    ground: Ground,
    recording: Recording,
    T_map_sensor: Float,
    options: BodyOptions,
    threads: int = 1,
) -> NDArray[np.float32]:
    """(E,) P(static), lowered for static elements of bodies of which enough is known to move.

    Args:
        p_static: (E,) by what is known of each element and of those right beside it.
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
    bodies = _core.Bodies3D(surface, stands, p_static, column=column, fewest=options.fewest)
    for scans, beams, offset in chunks(recording):
        points, hit = recording.points[beams], recording.hit[beams]
        bodies.add(points, hit, offset, T_map_sensor[scans], threads)
    return lowered(p_static, bodies.share(), options)


def above_ground(surface: Surface, ground: Ground, low: float, high: float) -> NDArray[np.bool_]:
    """(E,) whether an element's mean is between two heights (m) above the ground."""
    stands = np.empty(surface.size, np.bool_)
    for rows in blocks_of(surface):
        means = surface.elements(rows)[1]
        above = means[:, 2] - ground.at(means[:, :2])
        stands[slice(*rows)] = (above > low) & (above < high)
    return stands


def lowered(
    p_static: NDArray[np.float32], share: NDArray[np.float32], options: BodyOptions
) -> NDArray[np.float32]:
    """(E,) with log odds of slope (share - body's), -most at least, where that exceeds the share.

    Args:
        p_static: (E,).
        share: (E,) mean probability to move of the bodies around each; NaN: of none.
        options: see BodyOptions.
    """
    of = np.flatnonzero((p_static >= _STATIC) & (share > options.share))
    nats = np.minimum(options.slope * (share[of] - np.float32(options.share)), options.most)
    out = p_static.copy()
    out[of] = np.minimum(out[of], 1.0 / (1.0 + np.exp(nats)))
    return out
