"""The half of space.py that runs where DUFOMap and OctoMap are: needs nothing but them and NumPy.

python benchmarks/space_peer_worker.py CASE OUT.npy THREADS dufomap RESOLUTION D_S D_P
python benchmarks/space_peer_worker.py CASE OUT.npy THREADS octomap RESOLUTION

CASE is a folder that space_cases.py prepared: `points.bin` float32 x y z in the sensor's frame,
`offset.npy` (T+1,), `T_map_sensor.npy` (T, 4, 4). OUT.npy gets P(static) of every point as 0 or 1,
OUT.json seconds of wall clock and CPU. Sweeps are read one at a time.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np


class Sweeps:
    """The points (n, 3) float32 and the pose of each sweep."""

    def __init__(self, case):
        self.path = case / "points.bin"
        self.offset = np.load(case / "offset.npy")
        self.poses = np.load(case / "T_map_sensor.npy")

    def __iter__(self):
        with self.path.open("rb") as file:
            for count, T in zip(np.diff(self.offset), self.poses, strict=True):
                yield np.fromfile(file, np.float32, 3 * count).reshape(-1, 3), T


def dufomap(sweeps, threads, resolution, d_s, d_p):
    """Dynamic where space was once free for sure (Duberg et al. 2024)."""
    from dufomap import dufomap as library

    made = library(float(resolution), float(d_s), int(d_p), num_threads=threads)
    for points, T in sweeps:
        made.run(points, T, cloud_transform=True)
    made.oncePropagateCluster(if_propagate=True, if_cluster=False)
    for points, T in sweeps:
        yield np.asarray(made.segment(points, T, cloud_transform=True)) == 0


def octomap(sweeps, _threads, resolution):
    """Static where the voxel is occupied in the end (Hornung et al. 2013); its own parameters."""
    import octomap as library

    tree = library.OcTree(float(resolution))
    for points, T in sweeps:
        tree.insertPointCloud(in_map(points, T), T[:3, 3].copy())
    for points, T in sweeps:
        yield np.asarray(tree.getLabels(in_map(points, T))).ravel() == 1


def in_map(points, T):
    return np.ascontiguousarray(points @ T[:3, :3].T + T[:3, 3], dtype=np.float64)


def main(case, out, threads, method, *parameters):
    sweeps, wall, cpu = Sweeps(Path(case)), time.perf_counter(), time.process_time()
    label = {"dufomap": dufomap, "octomap": octomap}[method]
    static = np.concatenate(list(label(sweeps, int(threads), *parameters)))
    took = {"seconds": time.perf_counter() - wall, "cpu": time.process_time() - cpu}
    np.save(out, static.astype(np.float32))
    Path(out).with_suffix(".json").write_text(json.dumps(took))


if __name__ == "__main__":
    main(*sys.argv[1:])
