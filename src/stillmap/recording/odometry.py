"""Odometry at the time of a scan."""

import numpy as np
from numpy.typing import NDArray

from stillmap import se2


def interpolate(
    stamp_ns: NDArray[np.int64], poses: NDArray[np.float64], at_ns: NDArray[np.int64]
) -> tuple[NDArray[np.float64], int]:
    """Poses at given times: linear in x and y, along the shortest arc in theta.

    Args:
        stamp_ns: (N,) int64, N >= 1, in any order.
        poses: (N, 3) x, y in metres and theta in radians.
        at_ns: (T,) int64.

    Returns:
        (T, 3) poses, and how many of the times lie outside the span of `stamp_ns`: those take
        the nearest pose.
    """
    order = np.argsort(stamp_ns, kind="stable")
    stamp_ns, poses = stamp_ns[order], poses[order]
    after = np.clip(np.searchsorted(stamp_ns, at_ns, side="right"), 1, max(len(stamp_ns) - 1, 1))
    after = np.minimum(after, len(stamp_ns) - 1)
    before = np.maximum(after - 1, 0)
    span = (stamp_ns[after] - stamp_ns[before]).astype(float)
    share = (at_ns - stamp_ns[before]) / np.where(span > 0, span, 1.0)
    share = np.clip(share, 0.0, 1.0)[:, None]
    step = poses[after] - poses[before]
    step[:, 2] = se2.wrap(step[:, 2])
    outside = int(np.count_nonzero((at_ns < stamp_ns[0]) | (at_ns > stamp_ns[-1])))
    return poses[before] + share * step, outside
