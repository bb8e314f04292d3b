"""Packed sweeps of a street, with their pictures, as the KITTI folder that stillmap reads.

python benchmarks/unpacked.py ../shared/data/lidar3d/queue_000-039.npz OUT

Beside the pack lie `queue_images/NNNN.jpg`, one for each sweep, and `queue_calib.json`; packs
without them become folders without pictures.
"""

import argparse
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

PERIOD = 0.1  # s, from sweep to sweep
_UNIT = 0.0025  # m, of the packed coordinates
_CAMERA = 2  # colours, on the left


def unpack(pack: Path, out: Path, sweeps: int | None = None) -> Path:
    """Write `velodyne/`, `times.txt`, `poses_lidar.txt` and, where they are, `image_2/` and
    `calib.txt`.

    Args:
        pack: `NAME_FIRST-LAST.npz`.
        out: a folder; it may be there already.
        sweeps: so many, from the first on; None: all.

    Returns:
        `out`.
    """
    (out / "velodyne").mkdir(parents=True, exist_ok=True)
    name = pack.name.partition("_")[0]
    with np.load(pack) as arrays:
        offset, poses = arrays["offset"], arrays["pose"][:sweeps]
        points = arrays["xyz_2p5mm"]
        # packs may have none
        intensity = arrays.get("intensity", np.zeros(len(points), np.uint8))
    for k in range(len(poses)):
        its = slice(offset[k], offset[k + 1])
        rows = np.empty((offset[k + 1] - offset[k], 4), "<f4")
        rows[:, :3] = points[its].astype(np.float32) * np.float32(_UNIT)
        rows[:, 3] = intensity[its] / np.float32(255.0)
        rows.tofile(out / "velodyne" / f"{k:06d}.bin")
    np.savetxt(out / "poses_lidar.txt", poses[:, :3].reshape(-1, 12), fmt="%.9g")
    np.savetxt(out / "times.txt", PERIOD * np.arange(len(poses)), fmt="%.6f")
    if (pack.parent / f"{name}_calib.json").is_file():
        calibration = json.loads((pack.parent / f"{name}_calib.json").read_text())
        (out / "calib.txt").write_text(_calibration(calibration))
        (out / f"image_{_CAMERA}").mkdir(exist_ok=True)
        for k in range(len(poses)):
            picture = pack.parent / f"{name}_images" / f"{k:04d}.jpg"
            shutil.copy(picture, out / f"image_{_CAMERA}" / f"{k:06d}.jpg")
    return out


def _calibration(given: dict[str, Any]) -> str:
    """As odometry sequences have it: Tr leads to the first camera, rectified."""
    R = np.array(given["R_rect"])
    return _line(f"P{_CAMERA}", given["P2_cam2"]) + _line(
        "Tr", R @ np.array(given["Tr_velo_to_cam"])
    )


def _line(name: str, matrix: NDArray[np.float64] | list[list[float]]) -> str:
    return f"{name}: {' '.join(f'{value:.12g}' for value in np.ravel(matrix))}\n"


def main() -> None:
    p = argparse.ArgumentParser(description="Packed sweeps and pictures as a KITTI folder.")
    p.add_argument("pack", type=Path)
    p.add_argument("out", type=Path)
    p.add_argument("--sweeps", type=int, help="so many from the first on (default: all)")
    args = p.parse_args()
    print(unpack(args.pack, args.out, args.sweeps))


if __name__ == "__main__":
    main()
