"""Dwell times: how long objects were observed where they arrived, or before they departed."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.recording import Recording
from stillmap.mapping.change_detection import Change

Float = NDArray[np.float64]
Index = NDArray[np.intp]

_QUANTILE = 0.25  # of the observed times of an object's voxels


def measure_dwell_times(
    places: Sequence[Change], recording: Recording, poses: Float, resolution: float
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
    voxels = _Voxels.from_places(places)
    limits = np.iinfo(np.int64)
    first = np.full(len(voxels.place), limits.max)
    last = np.full(len(voxels.place), limits.min)
    since = np.array([one.stamp_ns if one.appeared else limits.min for one in places])[voxels.place]
    until = np.array([limits.max if one.appeared else one.before_ns for one in places])[
        voxels.place
    ]
    T_map_sensor = recording.T_map_sensor(poses)
    for t in recording.iter_scans(range(recording.n_scans)):
        stamp, beams, T = int(recording.stamp_ns[t]), recording.beams_of(t), T_map_sensor[t]
        points = recording.points[beams][recording.hit[beams]].astype(np.float64)
        ends = points @ T[:3, :3].T + T[:3, 3]
        hit = voxels.find(np.floor(ends / resolution).astype(np.int64))
        hit = hit[(since[hit] <= stamp) & (stamp <= until[hit])]
        first[hit] = np.minimum(first[hit], stamp)
        last[hit] = np.maximum(last[hit], stamp)
    out = []
    for number, one in enumerate(places):
        its = voxels.place == number
        known = last[its] >= first[its]
        shown = last[its] - one.stamp_ns if one.appeared else one.before_ns - first[its]
        seconds = np.where(known, 1e-9 * np.where(known, shown, 0), 0.0)
        out.append(float(np.quantile(seconds, _QUANTILE, method="lower")))
    return out


class _Voxels(NamedTuple):
    """The N voxels of all places; a voxel of several places is there several times.

    Attributes:
        place: (N,) place of each voxel.
        low, shape: (3,) lowest voxel and extent of the bounding box.
        key: (U,) rising keys of the distinct voxels.
        copies: (C, U) their indices among the N; -1 where there are fewer than C.
    """

    place: Index
    low: NDArray[np.int64]
    shape: NDArray[np.int64]
    key: NDArray[np.int64]
    copies: Index

    @classmethod
    def from_places(cls, places: Sequence[Change]) -> "_Voxels":
        cells = np.concatenate([one.cells for one in places])
        place = np.repeat(np.arange(len(places)), [len(one.cells) for one in places])
        low = cells.min(axis=0)
        shape = cells.max(axis=0) - low + 1
        key, of = np.unique(_keys(cells - low, shape), return_inverse=True)
        order = np.argsort(of, kind="stable")
        begins = np.searchsorted(of[order], np.arange(len(key)))
        rank = np.arange(len(of)) - begins[of[order]]
        copies = np.full((int(rank.max()) + 1, len(key)), -1, np.intp)
        copies[rank, of[order]] = order
        return cls(place, low, shape, key, copies)

    def find(self, cells: NDArray[np.int64]) -> Index:
        """Indices of the N voxels that are among cells (K, 3)."""
        inside = ((cells >= self.low) & (cells < self.low + self.shape)).all(axis=1)
        key = np.unique(_keys(cells[inside] - self.low, self.shape))
        at = np.minimum(np.searchsorted(self.key, key), len(self.key) - 1)
        found = self.copies[:, at[self.key[at] == key]]
        return found[found >= 0]


def _keys(cells: NDArray[np.int64], shape: NDArray[np.int64]) -> NDArray[np.int64]:
    x, y, z = cells.T
    return np.asarray((x * shape[1] + y) * shape[2] + z, np.int64)
