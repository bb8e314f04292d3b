"""Localization of a lidar in a known map, from random places, without a prior.

python benchmarks/live_sweep_places.py [--worlds hall street] [--seeds 11 12] [--starts 20]
    [--channels 16] [--columns 360]
python benchmarks/live_sweep_places.py --extend [--worlds corridor street] [--scans 520] ...

The map is `stillmap.build` (one iteration) of a run of another seed: other people and traffic,
other parked cars. Each start has up to 40 sweeps to be found, and 15 more are tracked. Errors are
in the frame in which the poses of the map fit the truth best. wrong: found more than 0.5 m off.
NEES: mean squared error of the position by its covariance, of 3.

--extend: the map is of the first half of a run, and another run of twice that length extends it. A
box beside the way is taken away between them, and another one brought. beyond: sweeps from more
than 5 m off the first route. shown: share of the voxels of 0.15 m with static returns of either run
(at the true poses, but for the box that is gone) with a point of the map within 0.15 m. ghosts:
share of the voxels of the map without any such return within 0.25 m.
"""

import argparse
import dataclasses
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from tables import markdown

from stillmap import build
from stillmap.live.mapper import LiveMapper
from stillmap.live.replay import iter_beams
from stillmap.results.point_cloud import cloud_from_folder
from stillmap.sim import scene_by_name, simulate
from stillmap.sim.walls import box
from stillmap.slam import deskew_recording
from stillmap.slam.options import SlamOptions

_SWEEPS = {"hall": 400, "street": 150, "crossing": 150, "corridor": 400}
_SEARCHED, _TRACKED, _WRONG = 40, 15, 0.5  # sweeps, sweeps, m
_TITLES = ("world", "seed", "starts", "found", "wrong", "sweeps until found: median", "max")
_FURTHER = ("m off: median", "max", "NEES", "CPU ms of a sweep: tracked", "of a search")
# sweeps and m/s of the run that extends a map; x, y, width, depth of what is gone, and of what came
_EXTENDED = {
    "corridor": (520, 2.0, (31.0, 2.1, 0.8, 0.45), (28.0, 2.1, 0.8, 0.45)),
    "street": (300, 5.0, (40.0, -11.6, 1.6, 1.0), (70.0, -11.6, 1.6, 1.0)),
}
_EDGE, _NEAR, _BEYOND = 0.15, 0.25, 5.0  # m
_OF_EXTENSION = (
    *("world", "seed", "sweeps", "found after", "lost then", "m off: known part, median", "max"),
    *("beyond", "max", "at the end", "shown by the map", "extended", "ghosts", "gone: voxels left"),
    *("came: shown", "CPU ms of a sweep: median", "99 %"),
)


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--extend", action="store_true")
    p.add_argument("--worlds", nargs="+", choices=_SWEEPS)
    p.add_argument("--seeds", nargs="+", type=int, default=[11, 12])
    p.add_argument("--starts", type=int, default=20)
    p.add_argument("--scans", type=int, help="of the run that extends the map")
    p.add_argument("--channels", type=int, default=16)
    p.add_argument("--columns", type=int, default=360)
    args = p.parse_args()
    score, titles = (extend, _OF_EXTENSION) if args.extend else (localize, (*_TITLES, *_FURTHER))
    lines = []
    for world in args.worlds or (_EXTENDED if args.extend else ["hall", "street"]):
        for seed in args.seeds:
            with tempfile.TemporaryDirectory() as folder:
                lines.append(score(world, seed, Path(folder) / "map", args))
            print(" | ".join(lines[-1]), flush=True)
    print(markdown(titles, lines))


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


def extend(world: str, seed: int, folder: Path, args: argparse.Namespace) -> list[str]:
    """A line of the table of maps that are extended."""
    scans, speed, gone, came = _EXTENDED[world]
    lidar = {"channels": args.channels, "columns": args.columns}
    scans = args.scans or scans

    def run(thing, seed: int, scans: int):
        changes = {"lidar": lidar, "robot": {"scans": scans, "speed": speed}}
        scene = scene_by_name(world, changes)
        walls = (*scene.walls, *box(*thing))
        return simulate(dataclasses.replace(scene, walls=walls), seed)

    first, second = run(gone, seed, scans // 2), run(came, seed + 100, scans)
    T_map_world = _make_map(first, folder)
    true, extended = T_map_world @ second.truth.T_world_base, folder.with_name("extended")
    off, ms = _extend_map(folder, extended, second, true)
    found = int(np.argmax(np.isfinite(off)))
    way, known = (one.truth.T_world_base[:, :2, 3] for one in (second, first))
    beyond = cKDTree(known).query(way)[0] > _BEYOND
    before, now = _static_ends(first), _static_ends(second)
    truth = np.concatenate([before[~_is_of(before, gone)], now])
    clouds = [_read_cloud(one, T_map_world) for one in (folder, extended)]
    ghosts = cKDTree(truth).query(_voxels(clouds[1]))[0] > _NEAR
    return [
        world,
        str(seed),
        str(scans),
        str(found + 1),
        str(int(np.isnan(off[found:]).sum())),
        *(f"{f(off[part]):.3f}" for part in (~beyond, beyond) for f in (np.nanmedian, np.nanmax)),
        f"{off[-1]:.3f}",
        *(f"{_share_shown(truth, one):.3f}" for one in clouds),
        f"{ghosts.mean():.4f}",
        "{} of {}".format(*(_count_left(one[_is_of(one, gone)], now) for one in clouds[::-1])),
        f"{_share_shown(now[_is_of(now, came)], clouds[1]):.3f}",
        *(f"{f:.0f}" for f in (np.median(ms[found + 1 :]), np.quantile(ms[found + 1 :], 0.99))),
    ]


def _extend_map(folder: Path, extended: Path, simulation, true):
    """(T,) m off at the time, NaN while it is lost, and CPU ms of each sweep."""
    off, ms = [], []
    options = {"threads": 1, "objects.enabled": False}
    with LiveMapper(options, place=folder, mode="extend") as mapper:
        for t, beams in enumerate(iter_beams(simulation.recording)):
            began = time.process_time()
            update = mapper.push(beams)
            ms.append(1e3 * (time.process_time() - began))
            is_lost = "lost" in update.doubts
            off.append(np.nan if is_lost else np.linalg.norm((update.pose - true[t])[:3, 3]))
        mapper.save(extended)
    return np.array(off), np.array(ms)


def _static_ends(simulation):
    """(N, 3) end points on what does not move, m in the world."""
    poses = simulation.truth.T_world_base
    deskewed = deskew_recording(simulation.recording, poses, SlamOptions())
    return deskewed.end_points(np.flatnonzero(deskewed.hit & simulation.truth.static), poses)


def _read_cloud(folder: Path, T_map_world):
    """(N, 3) static points of a map in the world."""
    blocks = cloud_from_folder(folder, "static").iter_blocks()
    points = np.concatenate([block.points for block in blocks])
    return (points - T_map_world[:3, 3]) @ T_map_world[:3, :3]


def _is_of(points, thing):
    """(N,) which points lie on a box, above the ground."""
    x, y, width, depth = thing
    off = np.abs(points[:, :2] - [x, y]) - 0.5 * np.array([width, depth])
    return (off < 0.1).all(axis=1) & (points[:, 2] > 0.2) & (points[:, 2] < 2.0)


def _voxels(points):
    return (np.unique(np.floor(points / _EDGE).astype(np.int64), axis=0) + 0.5) * _EDGE


def _count_left(points, now) -> int:
    """Number of voxels in which nothing stands any more: a wall behind the box does."""
    return int((cKDTree(now).query(_voxels(points))[0] > _EDGE).sum())


def _share_shown(truth, points) -> float:
    return float((cKDTree(points).query(_voxels(truth))[0] < _EDGE).mean())


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
