"""Given poses for the scans of a recording."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap import se2
from stillmap.errors import InputError
from stillmap.recording.model import Recording
from stillmap.recording.tum import read_tum

_NEAR_NS = 20_000_000  # another tool may have rounded its stamps


def poses_from_tum(path: Path, recording: Recording) -> NDArray[np.float64]:
    """(T, D+1, D+1) T_map_base at the scans of a recording, from a TUM trajectory.

    A trajectory with the very stamps of the recording is taken row by row (stamps may repeat);
    otherwise each scan takes the nearest pose within 20 ms.

    Raises:
        InputError: the file is no trajectory, or a scan has no pose.
    """
    stamp_ns, poses = read_tum(path)
    if recording.dimension == 2:
        poses = se2.planar(poses)
    if np.array_equal(stamp_ns, recording.stamp_ns):
        return poses
    order = np.argsort(stamp_ns, kind="stable")
    nearest = order[_nearest(stamp_ns[order], recording.stamp_ns)]
    missing = np.flatnonzero(np.abs(stamp_ns[nearest] - recording.stamp_ns) > _NEAR_NS)
    if len(missing):
        raise InputError(
            f"no pose within {_NEAR_NS / 1e9:g} s of {len(missing)} of {recording.n_scans} scans, "
            f"the first is scan {missing[0]} at {recording.stamp_ns[missing[0]] / 1e9:.3f} s",
            where=str(path),
        )
    return poses[nearest]


def _nearest(sorted_ns: NDArray[np.int64], wanted_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    right = np.clip(np.searchsorted(sorted_ns, wanted_ns), 1, max(len(sorted_ns) - 1, 1))
    right = np.minimum(right, len(sorted_ns) - 1)
    left = np.maximum(right - 1, 0)
    closer_left = wanted_ns - sorted_ns[left] <= sorted_ns[right] - wanted_ns
    return np.where(closer_left, left, right)
