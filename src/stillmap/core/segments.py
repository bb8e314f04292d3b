"""Line segments and boxes."""

import numpy as np

from stillmap.core.array_types import Bool, Float


def segments_meet_box(start: Float, end: Float, half_size: Float) -> Bool:
    """(n,) whether segments meet a box around the origin.

    Slab test: a segment lies between each pair of faces over an interval of its length.

    Args:
        start: (D,) where all segments begin, or (n, D).
        end: (n, D).
        half_size: (D,) from the center to the faces.
    """
    enters, leaves = np.zeros(len(end)), np.ones(len(end))
    for axis, half in enumerate(half_size.tolist()):
        at = start[..., axis]
        along = end[:, axis] - at
        with np.errstate(divide="ignore", invalid="ignore"):
            low, high = (-half - at) / along, (half - at) / along
        # parallel to the faces: all of the segment lies between them, or nothing
        beside = np.where(np.abs(at) > half, np.inf, -np.inf)
        is_parallel = along == 0.0
        enters = np.maximum(enters, np.where(is_parallel, beside, np.minimum(low, high)))
        leaves = np.minimum(leaves, np.where(is_parallel, -beside, np.maximum(low, high)))
    return np.asarray(enters <= leaves)
