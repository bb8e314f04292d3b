"""Poses of a result beside those that are true."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.errors import InputError
from stillmap.evaluation import files, trajectory
from stillmap.evaluation.folders import Truth

_STAMP_TOLERANCE = 1e-6  # seconds: a result carries the stamps of its recording


def paired(result: Path, truth: Truth) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Poses (N, 4, 4) of a result's trajectory, and the true ones (N, D+1, D+1) at their stamps.

    Raises:
        InputError: the trajectory is missing or damaged, or is of another recording.
    """
    estimated = files.read_trajectory(result / "trajectory.tum")
    stamps = files.seconds(truth.recording.stamp_ns)
    try:
        i, j = trajectory.associate(estimated.stamp_s, stamps, _STAMP_TOLERANCE)
    except InputError as error:
        what = f"is not of the recording in {truth.folder}: they have no stamp in common"
        raise InputError(what, where=str(result)) from error
    return estimated.poses[i], truth.poses()[j]
