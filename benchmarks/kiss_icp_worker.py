"""The half of lidar_poses.py that runs where kiss-icp is: needs nothing but that and NumPy.

python benchmarks/kiss_icp_worker.py SWEEPS.npz FOUND.npz THREADS [MAX_RANGE]

All parameters are the package's, but for the range, from which it takes the size of its voxels, and
the threads. SWEEPS.npz holds `points` (M, 3) in m in the frame of the sensor, `times` (M,) in s or
empty, `offset` (T+1,). FOUND.npz gets `poses` (T, 4, 4) of the sensor, which are those at the ends
of the sweeps, and `seconds` (T,) wall clock.
"""

import itertools
import sys
import time

import numpy as np
from kiss_icp.config.parser import load_config
from kiss_icp.kiss_icp import KissICP


def main(given: str, found: str, threads: str, max_range: str = "") -> None:
    with np.load(given) as data:
        points, times, offset = data["points"].astype(float), data["times"], data["offset"]
    config = load_config(None)
    if max_range:
        config.data.max_range = float(max_range)
        config.mapping.voxel_size = config.data.max_range / 100.0  # as load_config has it
    config.registration.max_num_threads = int(threads)
    odometry = KissICP(config)
    poses, seconds = [], []
    for first, last in itertools.pairwise(offset):
        sweep, when = points[first:last], times[first:last].astype(float)
        started = time.perf_counter()
        odometry.register_frame(sweep, when)
        seconds.append(time.perf_counter() - started)
        poses.append(odometry.last_pose)
    np.savez(found, poses=np.array(poses), seconds=np.array(seconds))


if __name__ == "__main__":
    main(*sys.argv[1:])
