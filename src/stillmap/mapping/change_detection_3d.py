"""Objects that arrived or departed in 3D recordings."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stillmap.core.recording import Recording
from stillmap.em import ChangedCells
from stillmap.mapping.change_detection import Change, group_changes
from stillmap.mapping.dwell_time import measure_dwell_times

_MIN_STAY = 12.0  # s: a shorter stay is a wait, a shorter absence an occlusion
_MIN_HEIGHT = 0.4  # m: anything lower is ground observed along other beams
_MIN_AREA = 0.7  # m2 of visible surface


def detect_changes_3d(
    changed: ChangedCells,
    recording: Recording,
    poses: NDArray[np.float64],
    resolution: float,
    time_bin: float,
) -> list[Change]:
    """Changed places that are objects at rest: high, large and present for long enough.

    `cells` of each are those of the plane (K, 2), `size` has three lengths, and `z` is known.

    Args:
        changed: candidate voxels.
        recording: 3D, deskewed.
        poses: (T, 4, 4) T_map_base.
        resolution: m, edge of a voxel.
        time_bin: s, width of a time bin.
    """
    first, last = recording.stamp_ns[[0, -1]].tolist()
    lasting = _select_lasting(changed, _MIN_STAY / time_bin, 1e-9 * (last - first) / time_bin)
    unchanged = np.zeros((0, 3), np.int64)  # large objects need no test against noise
    objects = [
        one
        for one in group_changes(lasting, unchanged, recording, resolution, time_bin)
        if one.size[2] >= _MIN_HEIGHT
        and len(one.cells) * resolution**2 >= _MIN_AREA
        and 1e-9 * min(one.stamp_ns - first, last - one.before_ns) >= _MIN_STAY
    ]
    dwell_times = measure_dwell_times(objects, recording, poses, resolution)
    return [
        replace(one, cells=np.unique(one.cells[:, :2], axis=0))
        for one, seconds in zip(objects, dwell_times, strict=True)
        if seconds >= _MIN_STAY
    ]


def _select_lasting(changed: ChangedCells, min_bins: float, bins: float) -> ChangedCells:
    """The cells that kept each state for at least `min_bins` of all `bins` time bins."""
    before, after = changed.change_bins[..., 0], changed.change_bins[..., 1]
    once = (after[:, 1] >= min_bins) & (bins - before[:, 1] >= min_bins)
    twice = before[:, 1] - after[:, 0] >= min_bins
    return changed.select(np.where(changed.n_changes == 1, once, twice))
