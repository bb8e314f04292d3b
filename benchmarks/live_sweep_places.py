"""Localization of a lidar in a known map, from random places, without a prior.

python benchmarks/live_sweep_places.py [--worlds hall street] [--seeds 11 12] [--starts 20]
    [--channels 16] [--columns 360]

The map is `stillmap.build` (one iteration) of a run of another seed: other people and traffic,
other parked cars. Each start has up to 40 sweeps to be found, and 15 more are tracked. Errors are
in the frame in which the poses of the map fit the truth best. wrong: found more than 0.5 m off.
NEES: mean squared error of the position by its covariance, of 3.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
from tables import markdown

from stillmap import build
from stillmap.live.mapper import LiveMapper
from stillmap.live.replay import iter_beams
from stillmap.sim import scene_by_name, simulate

_SWEEPS = {"hall": 400, "street": 150, "crossing": 150, "corridor": 400}
_SEARCHED, _TRACKED, _WRONG = 40, 15, 0.5  # sweeps, sweeps, m
_TITLES = ("world", "seed", "starts", "found", "wrong", "sweeps until found: median", "max")
_FURTHER = ("m off: median", "max", "NEES", "CPU ms of a sweep: tracked", "of a search")


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--worlds", nargs="+", default=["hall", "street"], choices=_SWEEPS)
    p.add_argument("--seeds", nargs="+", type=int, default=[11, 12])
    p.add_argument("--starts", type=int, default=20)
    p.add_argument("--channels", type=int, default=16)
    p.add_argument("--columns", type=int, default=360)
    args = p.parse_args()
    lines = []
    for world in args.worlds:
        for seed in args.seeds:
            with tempfile.TemporaryDirectory() as folder:
                lines.append(localize(world, seed, Path(folder) / "map", args))
            print(" | ".join(lines[-1]), flush=True)
    print(markdown([*_TITLES, *_FURTHER], lines))


def localize(world: str, seed: int, folder: Path, args: argparse.Namespace) -> list[str]:
    """A line of the table."""
    lidar = {"channels": args.channels, "columns": args.columns}
    scene = scene_by_name(world, {"lidar": lidar, "robot": {"scans": _SWEEPS[world]}})
    T_map_world = _make_map(simulate(scene, seed), folder)
    run = simulate(scene, seed + 100)
    true = T_map_world @ run.truth.T_world_base
    beams = list(iter_beams(run.recording))
    last = len(beams) - _SEARCHED - _TRACKED
    starts = np.random.default_rng(seed).integers(0, last, args.starts)
    needed, wrong, off, nees, tracked, searched = [], 0, [], [], [], []
    for start in starts.tolist():
        found, errors, squared, ms = _drive(folder, beams, true, start)
        searched += [one for one in ms[1 : None if found is None else found + 1] if one > 200.0]
        if found is not None:
            needed.append(found + 1)
            wrong += errors[0] > _WRONG
            off += errors
            nees += squared
            tracked += ms[found + 1 :]
    return [
        world,
        str(seed),
        str(len(starts)),
        str(len(needed)),
        str(wrong),
        *(f"{f(needed):.0f}" for f in (np.median, np.max)),
        *(f"{f(off):.3f}" for f in (np.median, np.max)),
        f"{np.mean(nees):.1f}",
        *(f"{np.median(one):.0f}" for one in (tracked, searched)),
    ]


def _make_map(simulation, folder: Path):
    """T_map_world (4, 4) under which the poses of the map are nearest to the truth."""
    result = build(simulation.recording, {"em.max_iterations": 1, "objects.enabled": False})
    result.save(folder)
    poses, true = result.poses, simulation.truth.T_world_base
    p, q = poses[:, :3, 3], true[:, :3, 3]
    # rotation: as the poses say, for a straight route does not
    u, _, vt = np.linalg.svd((poses[:, :3, :3] @ true[:, :3, :3].transpose(0, 2, 1)).sum(axis=0))
    T = np.eye(4)
    T[:3, :3] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    T[:3, 3] = p.mean(axis=0) - T[:3, :3] @ q.mean(axis=0)
    off = np.linalg.norm((T @ true)[:, :3, 3] - p, axis=1)
    print(f"map: {off.mean():.3f} m off, at most {off.max():.3f} m", flush=True)
    return T


def _drive(folder: Path, beams, true, start: int):
    """After how many sweeps it was found (None: not), m off and squared errors by the covariance
    since, and CPU ms of each sweep."""
    found, errors, nees, ms = None, [], [], []
    with LiveMapper({"threads": 1}, place=folder) as mapper:
        for k in range(_SEARCHED + _TRACKED):
            began = time.process_time()
            update = mapper.push(beams[start + k])
            ms.append(1e3 * (time.process_time() - began))
            if "lost" not in update.doubts:
                found = k if found is None else found
                off = update.pose[:3, 3] - true[start + k][:3, 3]
                errors.append(float(np.linalg.norm(off)))
                nees.append(float(off @ np.linalg.solve(update.covariance[:3, :3], off)))
            if (k >= _SEARCHED and found is None) or (found is not None and k > found + _TRACKED):
                break
    return found, errors, nees, ms


if __name__ == "__main__":
    main()
