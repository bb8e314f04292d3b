"""Objects that arrived or departed in 3D recordings, and how long they were observed at rest."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stillmap.core.recording import Recording
from stillmap.em import ChangedCells
from stillmap.mapping.change_detection import Change, group_changes

_MIN_STAY = 12.0  # s: a shorter stay is a wait, a shorter absence an occlusion
_MIN_HEIGHT = 0.4  # m: anything lower is ground observed along other beams
_MIN_AREA = 0.7  # m2 of visible surface
_DWELL_QUANTILE = 0.25  # of the observed times of an object's voxels


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


def measure_dwell_times(
    places: Sequence[Change], recording: Recording, poses: NDArray[np.float64], resolution: float
) -> list[float]:
    """Seconds for which three quarters of each object's voxels were hit while it stood there.

    A passing vehicle, or an object occluded soon after, arrives as well; but each of its voxels is
    hit for a moment only.

    Args:
        places: changed places; `cells` are (K, 3) voxels.
        recording: 3D, M beams, deskewed.
        poses: (T, 4, 4) T_map_base.
        resolution: metres, edge of a voxel.
    """
    if not places:
        return []
    # the N voxels of all places; one of several places is there several times
    voxels = np.concatenate([one.cells for one in places])
    place = np.repeat(np.arange(len(places)), [len(one.cells) for one in places])
    low, high = voxels.min(axis=0), voxels.max(axis=0)
    shape = tuple((high - low + 1).tolist())
    key = np.ravel_multi_index(tuple((voxels - low).T), shape)
    limits = np.iinfo(np.int64)
    first, last = np.full(len(place), limits.max), np.full(len(place), limits.min)
    since = np.array([one.stamp_ns if one.appeared else limits.min for one in places])[place]
    until = np.array([limits.max if one.appeared else one.before_ns for one in places])[place]
    T_map_sensor = recording.T_map_sensor(poses)
    for t in recording.iter_scans(range(recording.n_scans)):
        stamp, beams, T = int(recording.stamp_ns[t]), recording.beams_of(t), T_map_sensor[t]
        points = recording.points[beams][recording.hit[beams]].astype(np.float64)
        cells = np.floor((points @ T[:3, :3].T + T[:3, 3]) / resolution).astype(np.int64)
        inside = cells[((cells >= low) & (cells <= high)).all(axis=1)] - low
        was_hit = np.isin(key, np.ravel_multi_index(tuple(inside.T), shape))
        was_hit &= (since <= stamp) & (stamp <= until)
        first[was_hit] = np.minimum(first[was_hit], stamp)
        last[was_hit] = np.maximum(last[was_hit], stamp)
    out = []
    for number, one in enumerate(places):
        its = place == number
        shown = last[its] - one.stamp_ns if one.appeared else one.before_ns - first[its]
        seconds = 1e-9 * np.where(last[its] >= first[its], shown, 0)
        out.append(float(np.quantile(seconds, _DWELL_QUANTILE, method="lower")))
    return out
