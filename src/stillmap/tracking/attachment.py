"""Which tracks of a 3D recording are parts of static surfaces.

Where the E-step takes a part of a wall, a tree or a cupboard for dynamic, the surface goes on
around it: the beams beside its own are static, at the same range. Beside a mover they end behind.
"""

from collections import defaultdict
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stillmap.core.recording import Recording
from stillmap.tracking.objects import MovingObject

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]
Index = NDArray[np.intp]

_LOOKS = 4  # scans of a track that are evaluated
_NEIGHBORS = 8  # of a beam: the ring around it in an image
_MAX_STEP = 0.15  # m between the ranges of neighbors on one surface
_MARGIN = 0.03  # rad around an object, within which the neighbors of its beams are searched
_MAX_ATTACHMENT = 0.4  # one side of an object and its ground are less
_MIN_BEAMS = 5  # beside an object, for a decision


def drop_surface_parts(
    objects: Sequence[MovingObject], recording: Recording, p_static: NDArray[np.float32]
) -> list[MovingObject]:
    """The objects that are no part of a static surface.

    Args:
        objects: of the recording.
        recording: 3D, M beams, deskewed.
        p_static: (M,) P(c = 1) of every beam.
    """
    counts = count_neighbors(objects, recording, p_static)
    attached = counts[:, 0] > _MAX_ATTACHMENT * np.maximum(counts.sum(axis=1), _MIN_BEAMS)
    return [one for one, is_part in zip(objects, attached, strict=True) if not is_part]


def count_neighbors(
    objects: Sequence[MovingObject], recording: Recording, p_static: NDArray[np.float32]
) -> NDArray[np.int64]:
    """(K, 2) beams beside each object that end on its surface, and behind it.

    Static beams at the range of the object's nearest one end on its surface. Others at that range
    and before it do not count.
    """
    counts = np.zeros((len(objects), 2), np.int64)
    looks: dict[int, list[int]] = defaultdict(list)  # by scan: objects
    for k, one in enumerate(objects):
        for t in one.scan[:: -(-len(one.scan) // _LOOKS)].tolist():
            looks[t].append(k)
    for t in recording.iter_scans(sorted(looks), p_static):
        beams = recording.beams_of(t)
        numbers = beams.start + np.flatnonzero(recording.hit[beams])
        # `take` is several times as fast as an index where rows are short
        directions = recording.points.take(numbers, axis=0).astype(np.float64)
        x, y, z = directions.T  # a column at a time: rows of three numbers are slow
        ranges = np.sqrt(x * x + y * y + z * z)
        directions /= np.maximum(ranges, 1e-9)[:, None]
        is_static = p_static[numbers] >= 0.5
        for k in looks[t]:
            own = _find_own(numbers, objects[k].beams)
            counts[k] += _count_beside(directions, ranges, own, is_static)
    return counts


def _find_own(numbers: Index, beams: Index) -> Index:
    """Indices into the rising beam numbers (N,) of the rising beam numbers of an object."""
    first, last = np.searchsorted(beams, [numbers[0], numbers[-1] + 1]) if len(numbers) else (0, 0)
    return np.asarray(np.searchsorted(numbers, beams[first:last]))


def _count_beside(directions: Float, ranges: Float, own: Index, is_static: Bool) -> tuple[int, int]:
    """Beams beside an object's own that end on its surface, and behind it.

    Args:
        directions: (N, 3) of unit length.
        ranges: (N,) metres.
        own: beams of the object, rising.
        is_static: (N,) others that are static.
    """
    if not len(own):
        return 0, 0
    from scipy.spatial import cKDTree  # slow to load

    middle = directions[own].mean(axis=0)
    middle /= max(float(np.linalg.norm(middle)), 1e-9)
    away = directions @ middle
    reach = float(np.arccos(np.clip(away[own].min(), -1.0, 1.0))) + _MARGIN
    near = np.flatnonzero(away >= np.cos(min(reach, np.pi)))
    tree = cKDTree(directions[near])
    _, neighbors = tree.query(directions[own], k=min(_NEIGHBORS + 1, len(near)))
    is_beside = np.zeros(len(ranges), np.bool_)
    is_beside[near[neighbors]] = True
    is_beside[own] = False
    beside = np.flatnonzero(is_beside)
    if not len(beside):
        return 0, 0
    nearest = cKDTree(directions[own]).query(directions[beside])[1]
    step = ranges[beside] - ranges[own][nearest]
    on_it = (np.abs(step) <= _MAX_STEP) & is_static[beside]
    return int(np.count_nonzero(on_it)), int(np.count_nonzero(step > _MAX_STEP))
