"""The half of space_alignment.py that runs where KISS-Matcher and map-closures are.

PYTHON benchmarks/space_alignment_worker.py PAIRS.json OUT.json

PAIRS.json is a list of [reference.npy, session.npy]: points (N, 3) float32 of static surfaces, each
in the frame of its session. OUT.json gets a row per pair and method: `T` (4, 4) that maps the
session into the frame of the reference, `accepted`, and CPU seconds `cpu`. Needs NumPy and
whichever of the two libraries is to be compared; one that is not installed has no rows.
"""

import importlib.util
import json
import sys
import time
from pathlib import Path

import numpy as np

# local maps after the reference, which map-closures does not compare with the ones right before
_SKIPPED = 3
_FAR = 1000.0  # m, within which points of a map are kept: all


def match_kiss(reference, session, voxel_size):
    """KISS-Matcher (Lim et al. 2025)."""
    import kiss_matcher

    matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(voxel_size))
    found = matcher.estimate(list(session), list(reference))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = found.rotation, np.ravel(found.translation)
    return T, bool(found.valid)


def match_densities(reference, session, resolution, threshold):
    """MapClosures (Gupta et al. 2024), each session as one local map."""
    from map_closures.config import MapClosuresConfig
    from map_closures.map_closures import MapClosures
    from map_closures.voxel_map import VoxelMap

    config = MapClosuresConfig(density_map_resolution=resolution, density_threshold=threshold)
    closures, rng = MapClosures(config), np.random.default_rng(0)
    others = [rng.normal(0.0, 20.0, (5000, 3)) for _ in range(_SKIPPED)]
    for number, points in enumerate((reference, *others, session)):
        local_map = VoxelMap(resolution, _FAR)
        local_map.add_points(points)
        found = closures.get_best_closure(number, local_map.point_cloud())
    matched = found.source_id == 0 and found.number_of_inliers > config.inliers_threshold
    return np.array(found.pose), matched


METHODS = {
    "KISS-Matcher, voxels of 0.3 m (default)": ("kiss_matcher", match_kiss, (0.3,)),
    "KISS-Matcher, 1 m": ("kiss_matcher", match_kiss, (1.0,)),
    "map-closures, 0.5 m (default)": ("map_closures", match_densities, (0.5, 0.05)),
    "map-closures, 0.2 m, density .01": ("map_closures", match_densities, (0.2, 0.01)),
}


def main(pairs, out):
    rows = []
    for number, files in enumerate(json.loads(Path(pairs).read_text())):
        clouds = [np.load(file).astype(np.float64) for file in files]
        for name, (library, match, settings) in METHODS.items():
            if importlib.util.find_spec(library) is None:
                continue
            begun = time.process_time()
            T, accepted = match(*clouds, *settings)
            cpu = time.process_time() - begun
            row = {"pair": number, "method": name, "accepted": bool(accepted), "cpu": cpu}
            rows.append({**row, "T": T.tolist()})
    Path(out).write_text(json.dumps(rows))


if __name__ == "__main__":
    main(*sys.argv[1:])
