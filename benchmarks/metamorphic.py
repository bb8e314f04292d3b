"""Recorded logs, changed such that their truth stays: no change may tear the map.

python benchmarks/metamorphic.py FOLDER [--logs NAME ...] [--changes NAME ...] [--seed 0]
    [--jobs 2] [--out rows.csv] [--keep DIR]

FOLDER holds NAME.clf.gz, CARMEN logs, with NAME.relations or NAME.pseudo.relations, or neither.
A changed log is written to a file, and `stillmap map` makes a map of it as it does for a user; the
pieces of a log are given to `stillmap merge` in any order. A change knows which scans it keeps.

error, largest: of the relations between scans that are kept and have a pose, m; ratio: to the error
of the same relations in the map of the unchanged log, of which `largest_before` is the largest.
step: the largest from one pose to the next off the odometry of the unchanged log, m/s: by it logs
without relations are judged. tear: see `TEAR_METRES`. breaks: where the result says that the robot
was carried; apart: pieces that it did not place.

A row is appended to --out when its run ends. The table has the ratio, or without relations the
step, T where the map is torn, "refused" for exit status 2, and DEFECT for any other but 0.
"""

import csv
import gzip
import itertools
import json
import math
import tempfile
import zlib
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import session_merging as merging
from common import make_parser, outcomes
from numpy.typing import NDArray
from pairs import name_of, relations_beside
from tables import Row, grouped, markdown

from stillmap.core import se2
from stillmap.core.array_types import Float
from stillmap.io.carmen.log import ScanLine, parse_scan
from stillmap.io.trajectory import nearest_index
from stillmap.results.eval.readers import read_planar_trajectory, read_relations
from stillmap.results.eval.trajectory import MAX_DT, compute_relation_errors

Rng = np.random.Generator

# A map is torn where a relation is off by so many metres, and by so many times the worst of the
# unchanged log; without relations, where a step is so many m/s off odometry, and likewise.
TEAR_METRES, TEAR_STEP, TEAR_FACTOR = 2.0, 1.5, 4.0

UNCHANGED = "unchanged"
_PLACES = 6  # at which a log pauses or has gaps
_LEAST = 0.04  # of the scans, in a piece


class Log(NamedTuple):
    """The lines of a log, in the order of its file.

    Attributes:
        scans: (K,) what scans say; None: the line is odometry.
        was: (K,) s, the stamps in the unchanged log. stamp: (K,) s.
        pose: (K, 3) of the robot, as odometry has it. mount: (K, 3, 3) of the laser on it.
        fov: rad. reach: m; all that the laser sees.
    """

    scans: NDArray[np.object_]
    was: Float
    stamp: Float
    pose: Float
    mount: Float
    fov: float = math.inf
    reach: float = math.inf

    @property
    def scan(self) -> NDArray[np.bool_]:
        """(K,) whether a line is a scan."""
        return self.scans.astype(bool)

    def part(self, index: NDArray[Any]) -> "Log":
        """Some of the lines, or all in another order."""
        return Log(*(field[index] for field in self[:5]), self.fov, self.reach)

    def in_order(self) -> "Log":
        return self.part(np.argsort(self.stamp, kind="stable"))


def read_log(path: Path) -> Log:
    """The scans and the odometry of a log; no other line."""
    kinds = (b"ODOM", b"FLASER", b"ROBOTLASER1")
    with gzip.open(path, "rb") as file:
        words = [line.split() for line in file if line.startswith(kinds)]
    scans = np.empty(len(words), object)
    for k, line in enumerate(words):
        scans[k] = None if line[0] == b"ODOM" else parse_scan(line[0], line[1:])
    given = [line[1:4] * 2 if s is None else s.poses for line, s in zip(words, scans, strict=True)]
    laser, pose = np.array(given, float).reshape(-1, 2, 3).swapaxes(0, 1)
    stamp = np.array([line[-3] for line in words], float)
    return Log(scans, stamp, stamp, pose, se2.inverse(se2.matrix(*pose.T)) @ se2.matrix(*laser.T))


def write_log(log: Log, path: Path) -> None:
    lasers, texts = se2.parameters(se2.matrix(*log.pose.T) @ log.mount), []
    for scan, time, pose, laser in zip(log.scans, log.stamp, log.pose, lasers, strict=True):
        stamp, at = f"{time:.6f} host {time:.6f}", " ".join(f"{x:.6f}" for x in pose)
        if scan is None:
            texts.append(f"ODOM {at} 0 0 0 {stamp}\n")
        else:
            poses = " ".join(f"{x:.6f}" for x in laser) + " " + at
            texts.append(_scan_text(scan, log, poses, stamp) + "\n")
    path.write_text("".join(texts))


def _scan_text(scan: ScanLine, log: Log, poses: str, stamp: str) -> str:
    start, step, _, longest = scan.config
    angles = start + step * np.arange(len(scan.ranges))
    kept = np.abs(angles) < log.fov / 2 + 1e-3
    # where the laser sees nothing it says its reach
    n, ranges = kept.sum(), np.minimum(scan.ranges, log.reach)[kept]
    readings = f"{n} " + " ".join(f"{r:.3f}" for r in ranges)
    if longest is None and kept.all():  # as it was
        return f"FLASER {readings} {poses} {stamp}"
    header = f"{angles[kept][0]:.9f} {(n - 1) * step:.9f} {step:.9f} {longest or 0.0:.3f} 0.01 0"
    return f"ROBOTLASER1 0 {header} {readings} 0 {poses} 0 0 0 0 0 {stamp}"


def pause(log: Log, rng: Rng) -> Log:
    """At six places the robot rests for 5 to 300 s."""
    places = rng.uniform(log.stamp.min(), log.stamp.max(), _PLACES)
    later = places <= log.stamp[:, None]
    return log._replace(stamp=log.stamp + later @ rng.uniform(5.0, 300.0, _PLACES))


def drop(log: Log, rng: Rng, seconds: Any, every: float = 0.0, odometry: bool = False) -> Log:
    """Scans are missing for `seconds` (least, most), at six places or every so often; odometry, too
    if it is to be."""
    count = math.ceil(np.ptp(log.stamp) / every) if every else _PLACES
    starts = rng.uniform(log.stamp.min(), log.stamp.max(), count)
    since = log.stamp[:, None] - starts
    missing = ((since >= 0.0) & (since < rng.uniform(*seconds, count))).any(axis=1)
    return log.part(~(missing & (log.scan | odometry)))


def delay_lines(log: Log, rng: Rng) -> Log:
    """Of the scans 5 % are written up to 0.9 s late."""
    late = (log.scan & (rng.random(len(log.stamp)) < 0.05)) * rng.uniform(0, 0.9, len(log.stamp))
    return log.part(np.argsort(np.maximum.accumulate(log.stamp) + late, kind="stable"))


def reverse(log: Log, _rng: Rng) -> Log:
    """Driven backwards, from the end to the start."""
    both = log.stamp.min() + log.stamp.max()
    return log.part(np.arange(len(log.stamp))[::-1])._replace(stamp=both - log.stamp[::-1])


def take(log: Log, _rng: Rng, low: float, high: float) -> Log:
    """The part between two shares of the scans."""
    first, last = np.quantile(log.stamp[log.scan], [low, high])
    return log.part((log.stamp >= first) & (log.stamp <= last))


def thin(log: Log, rng: Rng, every: int) -> Log:
    """One scan of so many, and all odometry."""
    number = np.cumsum(log.scan) + rng.integers(every)
    return log.part(~log.scan | (number % every == 0))


def drive(log: Log, rng: Rng, change: Callable[[Float, Float, Rng], Float]) -> Log:
    """Other odometry: `change` of its steps (K, 3), each up to one of the stamps (K,)."""
    order = np.argsort(log.stamp, kind="stable")
    first, T = log.pose[order[0]], se2.matrix(*log.pose[order].T)
    steps = np.concatenate([np.zeros((1, 3)), se2.parameters(se2.inverse(T[:-1]) @ T[1:])])
    steps = change(steps, log.stamp[order], rng)
    theta = first[2] + np.cumsum(steps[:, 2])
    c, s = np.cos(theta - steps[:, 2]), np.sin(theta - steps[:, 2])
    x, y = c * steps[:, 0] - s * steps[:, 1], s * steps[:, 0] + c * steps[:, 1]
    pose = np.empty_like(log.pose)
    pose[order] = np.column_stack([first[0] + np.cumsum(x), first[1] + np.cumsum(y), theta])
    return log._replace(pose=pose)


def freeze(steps: Float, stamp: Float, rng: Rng) -> Float:
    """For 10 s, from when the robot moves."""
    start = stamp[rng.choice(np.flatnonzero(steps[:, :2].any(axis=1)))]
    return np.where(((stamp >= start) & (stamp < start + 10.0))[:, None], 0.0, steps)


def delay_odometry(log: Log, _rng: Rng) -> Log:
    """Odometry as it was 2 s before."""
    known = log.in_order()
    x, y, theta = known.pose.T
    was = [np.interp(log.stamp - 2.0, known.stamp, some) for some in (x, y, np.unwrap(theta))]
    return log._replace(pose=np.column_stack(was))


def cut(log: Log, rng: Rng, pieces: int) -> list[Log]:
    """Pieces, in any order."""
    inner = np.sort(rng.uniform(0.0, 1.0 - _LEAST * pieces, pieces - 1))
    places = np.quantile(log.stamp[log.scan], inner + _LEAST * np.arange(1, pieces))
    index = np.searchsorted(places, log.stamp)
    return [log.part(index == piece) for piece in rng.permutation(pieces).tolist()]


CHANGES: dict[str, Callable[[Log, Rng], Log | list[Log]]] = {
    UNCHANGED: lambda log, _: log,
    "pauses": pause,
    "gaps": partial(drop, seconds=(2.0, 30.0)),
    "gaps-in-both": partial(drop, seconds=(2.0, 30.0), odometry=True),
    "dropouts": partial(drop, seconds=(0.1, 1.0), every=4.0),
    "late-lines": delay_lines,
    "reversed": reverse,
    "first-half": partial(take, low=0.0, high=0.5),
    "second-half": partial(take, low=0.5, high=1.0),
    **{f"every-{k}": partial(thin, every=k) for k in (2, 3, 4, 5)},
    **{f"fov-{k}": lambda log, _, k=k: log._replace(fov=math.radians(k)) for k in (180, 120, 90)},
    **{f"range-{k}": lambda log, _, k=k: log._replace(reach=float(k)) for k in (12, 8, 5)},
    **{f"scale-{k}": partial(drive, change=lambda s, *_, k=k: s * (k, k, 1)) for k in (0.9, 1.1)},
    "frozen": partial(drive, change=freeze),
    # ways back count as ways ahead
    "no-direction": partial(drive, change=lambda s, *_: np.where([1, 0, 0], np.abs(s), s)),
    "no-rotation": partial(drive, change=lambda s, *_: s * (1.0, 1.0, 0.0)),
    "late-odometry": delay_odometry,
    **{f"pieces-{k}": partial(cut, pieces=k) for k in (2, 3, 4, 5)},
}


class Job(NamedTuple):
    """A change of a log; `folder` holds the map of the unchanged one, and of each change."""

    path: Path
    change: str
    seed: int
    folder: Path

    def result(self, change: str = "") -> Path:
        return self.folder / f"{name_of(self.path)}-{change or self.change}"


def run(job: Job) -> dict[str, Any]:
    """A row."""
    row = {"log": name_of(job.path), "change": job.change, "seed": job.seed}
    rng = np.random.default_rng([job.seed, zlib.crc32(f"{row['log']} {job.change}".encode())])
    log = read_log(job.path)
    changed = CHANGES[job.change](log, rng)
    logs = changed if isinstance(changed, list) else [changed]
    with tempfile.TemporaryDirectory() as scratch:
        files = [Path(scratch, f"{k}.log") for k in range(len(logs))]
        for some, file in zip(logs, files, strict=True):
            write_log(some, file)
        words = ("merge" if len(files) > 1 else "map", *files, "--threads", 1)
        try:
            done = merging.call(*words, "-o", job.result())
        except RuntimeError as error:
            print(error, flush=True)
            return {**row, "status": "DEFECT"}
    if done.status == merging.REFUSED:
        return {**row, "status": "refused", "cpu": round(done.cpu, 1)}
    return {**row, "status": "done", "cpu": round(done.cpu, 1), **score(job, log, logs)}


def score(job: Job, log: Log, logs: Sequence[Log]) -> dict[str, Any]:
    """What became of a changed log, or of its pieces, beside the unchanged one."""
    now = _trajectory(job.result(), logs)
    then = _trajectory(job.result(UNCHANGED), [log])
    relations, both = _known_relations(job.path, log), np.intersect1d(now[:, 0], then[:, 0])
    relations = relations[np.isin(relations[:, :2], both).all(axis=1)]
    a, b = (compute_relation_errors(one, relations, max_dt=0.0).translation for one in (now, then))
    steps = [_largest_step(one, log) for one in (now, then)]
    worst = (a.max, b.max, TEAR_METRES) if len(relations) else (*steps, TEAR_STEP)
    doubts = json.loads((job.result() / "run.json").read_text()).get("doubts", {})
    left_out = sum(not np.isin(log.was[log.scan], now[:, 0]).any() for log in logs)
    return {
        "scans": len(now),
        "relations": len(relations),
        "error": round(a.mean, 4),
        "ratio": round(a.mean / b.mean, 4),
        "largest": round(a.max, 3),
        "largest_before": round(b.max, 3),
        "step": round(steps[0], 3),
        "tear": int(worst[0] > max(worst[2], TEAR_FACTOR * worst[1])),
        "breaks": len(doubts.get("carried_before", [])),
        "apart": left_out,
    }


def _trajectory(result: Path, logs: Sequence[Log]) -> Float:
    """(N, 4) t, x, y, theta by the stamps of the unchanged log."""
    rows = read_planar_trajectory(result / "trajectory.tum")
    stamps = np.concatenate([np.c_[log.stamp, log.was][log.scan] for log in logs])
    stamp, was = stamps[np.argsort(stamps[:, 0])].T
    rows[:, 0] = was[nearest_index(stamp, rows[:, 0])]
    return rows[np.argsort(rows[:, 0], kind="stable")]


def _known_relations(path: Path, log: Log) -> Float:
    """(R, 8) between scans of an unchanged log, whose stamps replace those that were rounded."""
    file, scans = relations_beside(path), np.sort(log.stamp[log.scan])
    relations = read_relations(file) if file.exists() else np.empty((0, 8))
    wanted = relations[:, :2].copy()
    relations[:, :2] = scans[nearest_index(scans, wanted.ravel())].reshape(-1, 2)
    return relations[(np.abs(relations[:, :2] - wanted) <= MAX_DT).all(axis=1)]


def _largest_step(poses: Float, log: Log) -> float:
    """m/s from one pose to the next, off the odometry of the unchanged log."""
    scans = log.part(log.scan).in_order()
    known = scans.pose[nearest_index(scans.stamp, poses[:, 0])]
    T, T_odom = se2.matrix(*poses[:, 1:].T), se2.matrix(*known.T)
    off = se2.inverse(T[:-1]) @ T[1:] - se2.inverse(T_odom[:-1]) @ T_odom[1:]
    steps = np.linalg.norm(off[:, :2, 2], axis=1) / np.maximum(np.diff(poses[:, 0]), 1.0)
    return float(steps.max(initial=0.0))


_COLUMNS = (
    *("log", "change", "seed", "status", "cpu", "scans", "relations", "error", "ratio", "largest"),
    *("largest_before", "step", "tear", "breaks", "apart"),
)


def main() -> None:
    p = make_parser(__doc__)
    p.add_argument("folder", type=Path)
    p.add_argument("--logs", nargs="+", help="all of the folder, if none is named")
    p.add_argument("--changes", nargs="+", choices=CHANGES, default=list(CHANGES))
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--jobs", type=int, default=2, help="runs at a time, one thread each")
    p.add_argument("--out", type=Path, help="CSV to which rows are appended")
    p.add_argument("--keep", type=Path, help="folder for results")
    args = p.parse_args()
    names = args.logs or sorted(name_of(path) for path in args.folder.glob("*.clf.gz"))
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = args.keep or Path(scratch)
        # the unchanged logs first: the others are compared with them
        for changes in ([UNCHANGED], [name for name in args.changes if name != UNCHANGED]):
            pairs = itertools.product(names, changes)
            jobs = [
                Job(args.folder / f"{log}.clf.gz", one, args.seed, folder) for log, one in pairs
            ]
            for _, row in outcomes(run, jobs, args.jobs):
                rows.append(row)
                if args.out:
                    append(args.out, row)
            names = [row["log"] for row in rows if row["status"] == "done"]
    print(table(rows))


def append(path: Path, row: Row) -> None:
    """Append a row to a CSV file, which need not be there."""
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, _COLUMNS)
        if not file.tell():
            writer.writeheader()
        writer.writerow(row)


def table(rows: Sequence[Row]) -> str:
    """Changes by logs."""
    cells = {(row["change"], row["log"]): _cell(row) for row in rows}
    changes, logs = (list(grouped(rows, lambda row, k=k: row[k])) for k in ("change", "log"))
    lines = [[one, *(cells.get((one, log), "") for log in logs)] for one in changes]
    return markdown(["change", *logs], lines)


def _cell(row: Row) -> str:
    if row["status"] != "done":
        return str(row["status"])
    told = f"{row['ratio']:.2f}" if row["relations"] else f"{row['step']:.2f} m/s"
    return told + " T" * row["tear"]


if __name__ == "__main__":
    main()
