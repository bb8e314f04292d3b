"""`map.npz`: the occupancy grid with the sums it is made from and the looks it rests on."""

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.output.protocols import EvidenceLike, OccupancyMapLike


def write_map_npz(
    path: Path, occupancy: OccupancyMapLike, evidence: EvidenceLike | None = None
) -> None:
    """Write `p_occupied`, `alpha`, `beta` (H, W), `origin` (x, y, yaw), `resolution` in metres.

    Where evidence is given: `looks`, `clear_looks`, `thin` (H, W).
    """
    arrays: dict[str, NDArray[Any]] = {
        "p_occupied": np.asarray(occupancy.p_occupied, np.float32),
        "alpha": np.asarray(occupancy.alpha, np.float32),
        "beta": np.asarray(occupancy.beta, np.float32),
    }
    if evidence is not None:
        arrays |= {
            "looks": np.asarray(evidence.looks, np.uint16),
            "clear_looks": np.asarray(evidence.clear, np.uint16),
            "thin": np.asarray(evidence.thin, np.bool_),
        }
    arrays |= {
        "origin": np.asarray(occupancy.origin, np.float64),
        "resolution": np.asarray(occupancy.resolution, np.float64),
    }
    write_npz(path, arrays)


def write_npz(path: Path, arrays: dict[str, NDArray[Any]]) -> None:
    """Write arrays by their names. Equal ones give equal bytes: the archive's dates are fixed."""
    # most cells of most maps are alike: a tenth of the size, and quicker than writing them all;
    # beyond level 1 it takes three times as long for a few percent
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, array, allow_pickle=False)
