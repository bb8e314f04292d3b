"""Does a fleet give the same bytes as maps made one by one, and how much faster is it?

python benchmarks/fleet.py [--recordings 12] [--scans 600] [--seed 100]
    [--only local dask disturbed]

Simulated halls are mapped one by one with `stillmap map --threads 1`, then as fleets: by one and by
two local processes, and by two workers of a Dask cluster. The last fleet is disturbed: its client
is interrupted in the midst and given the same command again, then one worker is killed (SIGKILL).
Every result is compared, file by file, with the one made by hand; what tells of time and memory is
left out. CPU time is that of all tasks; the speed-up counts from the fleet of one process. "Others"
are what else the machine was busy with meanwhile, in cores on average (Linux).
"""

import json
import math
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from common import make_parser
from distributed import LocalCluster
from tables import markdown

_OWN = {"fleet.json", "fleet.html"}
_KINDS = ("local", "dask", "disturbed")


class Cluster(NamedTuple):
    """A Dask cluster of this machine: its address, and the ids of its workers."""

    address: str
    workers: list[int]


def main() -> None:
    p = make_parser(__doc__)
    p.add_argument("--recordings", type=int, default=12)
    p.add_argument("--scans", type=int, default=600)
    p.add_argument("--seed", type=int, default=100)
    p.add_argument("--only", nargs="+", choices=_KINDS, default=_KINDS)
    args = p.parse_args()
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        names = [f"hall{args.seed + k}" for k in range(args.recordings)]
        for k, one in enumerate(names):
            scans, seed = str(args.scans), str(args.seed + k)
            words = ("-o", str(work / "in" / one), "--scans", scans, "--seed", seed, "--quiet")
            call("simulate", "hall", *words)
        seconds, by_hand = map_by_hand(work, names)
        rows = [["one by one", f"{seconds:.1f}", "", "", "", ""]]
        alone = 0.0
        for jobs, what in enumerate(("local, 1 process", "local, 2 processes"), 1):
            if "local" in args.only:
                measured = run_fleet(work, work / what, "--jobs", str(jobs))
                alone = alone or measured[0]
                rows.append(describe(what, work / what, measured, alone, by_hand))
        if {"dask", "disturbed"} & set(args.only):
            rows += run_on_dask(work, args.only, alone, by_hand)
    titles = ["how", "s", "CPU s of all tasks", "others", "speed-up", "results that are equal"]
    print(markdown(titles, rows))


def run_on_dask(
    work: Path, only: list[str], alone: float, by_hand: dict[str, dict[str, bytes]]
) -> list[list[str]]:
    """The rows of the fleets on a cluster."""
    rows = []
    with start_cluster() as cluster:
        if "dask" in only:
            # the workers are no children of the client: their time cannot be told from others'
            seconds, _ = run_fleet(work, work / "dask", "--scheduler", cluster.address)
            measured = seconds, math.nan
            rows.append(describe("Dask, 2 workers", work / "dask", measured, alone, by_hand))
        if "disturbed" in only:
            measured = disturb(work, work / "disturbed", cluster), math.nan
            what = "Dask, client interrupted, 1 of 2 workers killed"
            rows.append(describe(what, work / "disturbed", measured, 0.0, by_hand))
    return rows


def call(*words: str) -> None:
    subprocess.run([sys.executable, "-m", "stillmap", *words], check=True)


def map_by_hand(work: Path, names: list[str]) -> tuple[float, dict[str, dict[str, bytes]]]:
    begun = time.monotonic()
    for one in names:
        words = ("-o", str(work / "hand" / one), "--quiet", "--threads", "1")
        call("map", str(work / "in" / one), *words)
    seconds = time.monotonic() - begun
    return seconds, {one: contents(work / "hand" / one) for one in names}


def contents(folder: Path) -> dict[str, bytes]:
    """All files of a result, without what tells of time and memory in them."""
    out = {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    out.pop("made.json", None)
    record = json.loads(out["run.json"])
    for name in ("seconds", "cpu_seconds", "peak_memory_bytes"):
        del record[name]
    for iteration in record["iterations"]:
        del iteration["seconds"]
    report = re.sub(rb"<h3>Time and memory</h3>.*?</details>", b"", out["report.html"], flags=re.S)
    report = re.sub(rb"<div><dt>(Computed in|Peak memory)</dt>.*?</div>", b"", report)
    report = re.sub(rb"<td[^<>]*>[0-9.,]+ (ms|s|min)</td>", b"", report)
    return {**out, "run.json": json.dumps(record).encode(), "report.html": report}


def run_fleet(work: Path, out: Path, *words: str) -> tuple[float, float]:
    """Seconds, and the cores that others kept busy meanwhile."""
    begun, busy, own = time.monotonic(), busy_seconds(), own_seconds()
    call("fleet", str(work / "in"), "-o", str(out), "--quiet", *words)
    seconds = time.monotonic() - begun
    others = busy_seconds() - busy - (own_seconds() - own)
    return seconds, max(0.0, others) / seconds


def busy_seconds() -> float:
    """CPU time of all processes of the machine since it was started."""
    user, nice, system = Path("/proc/stat").read_text().split()[1:4]
    return (int(user) + int(nice) + int(system)) / os.sysconf("SC_CLK_TCK")


def own_seconds() -> float:
    """CPU time of the children that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def describe(
    what: str,
    out: Path,
    measured: tuple[float, float],
    alone: float,
    by_hand: dict[str, dict[str, bytes]],
) -> list[str]:
    """A row of the table.

    Raises:
        RuntimeError: a temporary file is left.
    """
    files = {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()}
    left = {one for one in files - _OWN if not one.startswith("results/") or "/." in one}
    if left:
        raise RuntimeError(f"left behind: {sorted(left)}")
    same = 0
    for name, expected in by_hand.items():
        same += contents(out / "results" / name) == expected
    listed = json.loads((out / "fleet.json").read_text())
    cpu = sum(one["cpu_seconds"] for one in listed)
    seconds, others = measured
    faster = f"{alone / seconds:.2f}" if alone else ""
    shown = "" if math.isnan(others) else f"{others:.2f}"
    equal = f"{same} of {len(by_hand)}"
    return [what, f"{seconds:.1f}", f"{cpu:.1f}", shown, faster, equal]


@contextmanager
def start_cluster() -> Iterator[Cluster]:
    """Two workers of one thread each, as processes."""
    with LocalCluster(n_workers=2, threads_per_worker=1, memory_limit=None) as cluster:
        workers = [worker.process.pid for worker in cluster.workers.values()]
        yield Cluster(cluster.scheduler_address, workers)


def disturb(work: Path, out: Path, cluster: Cluster) -> float:
    """A fleet whose client is interrupted and whose worker is killed; the seconds of both runs."""
    words = ("fleet", str(work / "in"), "-o", str(out), "--scheduler", cluster.address, "--quiet")
    begun = time.monotonic()
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # a child inherits it when ignored
    client = subprocess.Popen([sys.executable, "-m", "stillmap", *words])
    wait_for_results(out, 2)
    client.send_signal(signal.SIGINT)
    if client.wait() != 130:
        raise RuntimeError(f"an interrupted client ended with status {client.returncode}")
    client = subprocess.Popen([sys.executable, "-m", "stillmap", *words])
    wait_for_results(out, 5)
    os.kill(cluster.workers[0], signal.SIGKILL)
    if client.wait() != 0:
        raise RuntimeError(f"the fleet ended with status {client.returncode}")
    return time.monotonic() - begun


def wait_for_results(out: Path, number: int) -> None:
    while len(list(out.glob("results/*/run.json"))) < number:
        time.sleep(0.05)


if __name__ == "__main__":
    main()
