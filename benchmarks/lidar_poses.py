"""Poses from sweeps of spinning lidars, beside kiss-icp, one after the other in one run.

python benchmarks/lidar_poses.py RECORDING ... [--kiss-python PYTHON] [--kiss-range M ...]
    [--threads 2] [--set slam.odometry.KEY=VALUE ...]

RECORDING is a folder written by `stillmap simulate WORLD --lidar CHANNELS`, or any recording in
space that states poses. Poses are compared with the true ones, or else with those stated, which may
be another program's. Odometry is left out. `e = 1` believes every beam, `true e`
knows which beams met something static; it is there where there is truth.

ATE is the RMSE in m after the best rigid alignment; RPE over 1 m of travel, RMSE. kiss-icp's poses
are those at the ends of its sweeps and are compared with the truth there; `kiss-icp, R m` is told
that range, from which it takes its voxels (R / 100). Scatter needs no truth: the median standard
deviation in mm of points across surfaces, in the cloud that all sweeps make together, of points
between 3 and 40 m, within 0.4 m. It is not given where beams have times, as every method has them
elsewhere. Seconds per sweep are wall clock, reading left out.
"""

import argparse
import dataclasses
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from tables import markdown

from stillmap.core import config, se2, se3
from stillmap.core.recording import Recording
from stillmap.io.reader import read
from stillmap.pipeline.options import Options
from stillmap.prepare.options import ReadOptions
from stillmap.results.eval.trajectory import compute_absolute_errors, compute_relative_errors
from stillmap.sim import load_truth
from stillmap.sim.truth import FOLDER
from stillmap.slam import lidar_odometry

Float = NDArray[np.float64]

_HEADER = ["recording", "method", "ATE m", "RPE m", "RPE deg", "scatter mm", "s per sweep"]


@dataclasses.dataclass(frozen=True, eq=False)
class Case:
    """A recording, its true poses at times after the stamps, and which beams are static."""

    name: str
    recording: Recording
    truth: Float
    e: NDArray[np.float32] | None


def case_of(path: Path) -> Case:
    """A recording with truth or stated poses.

    Raises:
        ValueError: there are neither.
    """
    recording, e = read(path, ReadOptions()), None
    if (path / FOLDER).is_dir():
        known = load_truth(path)
        truth, e = known.T_world_base, known.static.astype(np.float32)
    elif recording.T_recorded_base is not None:
        truth = recording.T_recorded_base
    else:
        raise ValueError(f"{path}: there is no truth and no poses are stated")
    return Case(path.name, recording.without_odometry(), truth, e)


def later(truth: Float, stamp_ns: NDArray[np.int64], seconds: float) -> Float:
    """(T, 4, 4) poses that many seconds after those given, moving on as to the next one."""
    steps = se3.log(se2.inverse(truth[:-1]) @ truth[1:])
    per_second = steps / (1e-9 * np.diff(stamp_ns))[:, None]
    out: Float = truth @ se3.exp(seconds * np.concatenate([per_second, per_second[-1:]]))
    return out


def kiss_icp(case: Case, python: str, threads: int, max_range: str) -> tuple[Float, float]:
    """(T, 4, 4) poses of the base at the ends of sweeps, and seconds per sweep."""
    recording = case.recording
    kept = recording.hit & np.isfinite(recording.points).all(axis=1)
    offset = np.concatenate([[0], np.cumsum(kept)])[recording.offset]
    times = np.zeros(0) if recording.beam_time is None else recording.beam_time[kept]
    with tempfile.TemporaryDirectory() as folder:
        given, found = Path(folder) / "sweeps.npz", Path(folder) / "found.npz"
        np.savez(given, points=recording.points[kept], times=times, offset=offset)
        worker = Path(__file__).with_name("kiss_icp_worker.py")
        command = [python, str(worker), str(given), str(found), str(threads), max_range]
        subprocess.run([word for word in command if word], check=True)
        with np.load(found) as data:
            poses, seconds = data["poses"], data["seconds"]
    X = recording.T_base_sensor[0]
    return X @ poses @ se2.inverse(X), float(np.mean(seconds))


def stillmap(
    case: Case, e: NDArray[np.float32], chosen: Options, threads: int
) -> tuple[Float, float]:
    """(T, 4, 4) poses at the stamps, and seconds per sweep."""
    started = time.perf_counter()
    found = lidar_odometry.register_sweeps(
        case.recording, e, chosen.slam.odometry, _silent, threads
    )
    return found.poses, (time.perf_counter() - started) / case.recording.n_scans


def _silent(done: int, total: int) -> None:
    pass


def scatter(recording: Recording, poses: Float) -> float:
    """Median standard deviation, m, across surfaces of the cloud that all sweeps make."""
    clouds = []
    for t in range(0, recording.n_scans, 3):
        beams = recording.beams_of(t)
        points = recording.points[beams][recording.hit[beams]].astype(float)
        distance = np.linalg.norm(points, axis=1)
        points = points[(distance > 3.0) & (distance < 40.0)][::3]
        clouds.append(points @ poses[t, :3, :3].T + poses[t, :3, 3])
    cloud = np.concatenate(clouds)
    across = []
    for near in cKDTree(cloud).query_ball_point(cloud[:: max(1, len(cloud) // 4000)], 0.4):
        if len(near) < 15:
            continue
        variance = np.linalg.eigvalsh(np.cov(cloud[near].T))
        if variance[1] > 0.1 * variance[2] and variance[0] < 0.1 * variance[1]:
            across.append(np.sqrt(variance[0]))
    return float(np.median(across)) if across else float("nan")


def rows(case: Case, args: argparse.Namespace, chosen: Options) -> Iterator[list[str]]:
    """A line of the table for every method."""
    recording = case.recording
    ones = np.ones(recording.n_beams, np.float32)
    yield row(case, "stillmap, e = 1", *stillmap(case, ones, chosen, args.threads), 0.0)
    if case.e is not None:
        yield row(case, "stillmap, true e", *stillmap(case, case.e, chosen, args.threads), 0.0)
    if args.kiss_python:
        end = 0.0 if recording.beam_time is None else float(recording.beam_time.max())
        for max_range in ["", *args.kiss_range]:
            found = kiss_icp(case, args.kiss_python, args.threads, max_range)
            name = f"kiss-icp, {max_range} m" if max_range else "kiss-icp"
            yield row(case, name, *found, end)


def row(case: Case, method: str, poses: Float, seconds: float, after: float) -> list[str]:
    """The figures of poses (T, 4, 4) at times `after` the stamps."""
    recording = case.recording
    truth = later(case.truth, recording.stamp_ns, after) if after else case.truth
    relative = compute_relative_errors(poses, truth)
    across = scatter(recording, poses) if recording.beam_time is None else float("nan")
    return [
        case.name,
        method,
        f"{compute_absolute_errors(poses, truth).rmse:.4f}",
        f"{relative.translation.rmse:.4f}",
        f"{relative.rotation.rmse:.3f}",
        "" if np.isnan(across) else f"{1e3 * across:.1f}",
        f"{seconds:.3f}",
    ]


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("recordings", nargs="+", type=Path)
    p.add_argument("--kiss-python", help="a Python that has kiss-icp; not set: stillmap alone")
    p.add_argument("--kiss-range", nargs="+", default=[], metavar="M")
    p.add_argument("--threads", type=int, default=2)
    p.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", dest="settings")
    args = p.parse_args()
    changes = config.merge_nested(*(config.parse_assignment(text) for text in args.settings))
    chosen = config.override(Options(), changes)
    lines = []
    for path in args.recordings:
        case = case_of(path)
        for line in rows(case, args, chosen):
            print(*line, sep="  ", file=sys.stderr, flush=True)
            lines.append(line)
    print(markdown(_HEADER, lines))


if __name__ == "__main__":
    main()
