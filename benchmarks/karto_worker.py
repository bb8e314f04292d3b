"""The half of karto.py that runs where yag-slam is: needs nothing but that and NumPy.

python benchmarks/karto_worker.py SCANS.npz FOUND.npz

All parameters are the package's: its matcher's `default_config` and `default_config_loop` (the
defaults of its README), GraphSlam's own, loop closure on. Among them a range threshold of 20 m.
`GraphSlam.default()`, which would say so in fewer words, fails in 0.3.0.

SCANS.npz holds `ranges` (K, n) in m, `odometry` (K, 3) of the laser: x, y, heading, `first_angle`
and `angle_step` in rad. FOUND.npz gets `poses` and `answers` (K, 3) of the laser, at the end and
when each scan had been processed, with the loops that it closed; `closed` and `cpu` in seconds, of
the scans alone: neither the imports nor the files.
"""

import sys
import time

import numpy as np
from yag_slam.graph_slam import GraphSlam
from yag_slam.helpers import default_config
from yag_slam.models import LocalizedRangeScan
from yag_slam.scan_matching import Scan2DMatcherCpp

_MIN_RANGE = 0.02  # m


def main(given: str, found: str) -> None:
    with np.load(given) as data:
        ranges, odometry = data["ranges"], data["odometry"]
        first, step = float(data["first_angle"]), float(data["angle_step"])
    last, farthest = first + step * (ranges.shape[1] - 1), float(np.nanmax(ranges))
    threshold = default_config["range_threshold"]
    slam = GraphSlam(Scan2DMatcherCpp({}), Scan2DMatcherCpp({}, loop=True))
    scans, answers, closed = [], [], 0
    started = time.process_time()
    for readings, pose in zip(ranges.tolist(), odometry.tolist(), strict=True):
        laser = (first, last, step, _MIN_RANGE, farthest, threshold)
        scans.append(LocalizedRangeScan(readings, *laser, *pose))
        _, has_closed = slam.process_scan(scans[-1])
        closed += bool(has_closed)
        answers.append(_to_row(scans[-1]))
    cpu = time.process_time() - started
    poses = np.array([_to_row(scan) for scan in scans])
    np.savez(found, poses=poses, answers=np.array(answers), closed=closed, cpu=cpu)


def _to_row(scan: LocalizedRangeScan) -> tuple[float, float, float]:
    pose = scan.corrected_pose
    return pose.x, pose.y, pose.euler[-1]


if __name__ == "__main__":
    main(*sys.argv[1:])
