"""Does a fleet give the same bytes as maps made one by one, and how much faster is it?

python benchmarks/fleet.py [--recordings 12] [--scans 600] [--seed 100] [--chaos-only]

Simulated halls are mapped one by one with `stillmap map --threads 1`, then as fleets: by one and by
two local processes, and by two workers of a Dask cluster. The last fleet is disturbed: its client
is interrupted in the midst and given the same command again, then one worker is killed (SIGKILL).
Every result is compared, file by file, with the one made by hand; what tells of time and memory is
left out. CPU time is that of all tasks; the speed-up counts from the fleet of one process.
"""

import argparse
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from interrupted import contents
from tables import markdown

_OWN = {"fleet.json", "fleet.html", ".fleet/lock", ".fleet/journal.jsonl"}
_QUIET = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}


class Cluster(NamedTuple):
    """A Dask cluster of this machine: its address, and the ids of its workers."""

    address: str
    workers: list[int]


def main() -> None:
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("--recordings", type=int, default=12)
    p.add_argument("--scans", type=int, default=600)
    p.add_argument("--seed", type=int, default=100)
    p.add_argument("--chaos-only", action="store_true", help="the disturbed fleet alone")
    args = p.parse_args()
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        names = [f"hall{args.seed + k}" for k in range(args.recordings)]
        for k, one in enumerate(names):
            scans, seed = str(args.scans), str(args.seed + k)
            words = ("-o", str(work / "in" / one), "--scans", scans, "--seed", seed, "--quiet")
            call("simulate", "hall", *words)
        seconds, by_hand = map_by_hand(work, names)
        rows = [["one by one", f"{seconds:.1f}", "", "", ""]]
        local = [] if args.chaos_only else [("local, 1 process", ("--jobs", "1"))]
        local += [] if args.chaos_only else [("local, 2 processes", ("--jobs", "2"))]
        alone = 0.0
        for what, words in local:
            seconds = run_fleet(work, work / what, *words)
            alone = alone or seconds
            rows.append(describe(what, work / what, seconds, alone, by_hand))
        with start_cluster(work) as cluster:
            if not args.chaos_only:
                seconds = run_fleet(work, work / "dask", "--scheduler", cluster.address)
                rows.append(describe("Dask, 2 workers", work / "dask", seconds, alone, by_hand))
            seconds = disturb(work, work / "chaos", cluster)
            what = "Dask, client interrupted, 1 of 2 workers killed"
            rows.append(describe(what, work / "chaos", seconds, 0.0, by_hand))
    print(markdown(["how", "s", "CPU s of all tasks", "speed-up", "results that are equal"], rows))


def call(*words: str) -> None:
    subprocess.run([sys.executable, "-m", "stillmap", *words], check=True)


def map_by_hand(work: Path, names: list[str]) -> tuple[float, dict[str, dict[str, bytes]]]:
    begun = time.monotonic()
    for one in names:
        words = ("-o", str(work / "hand" / one), "--quiet", "--threads", "1")
        call("map", str(work / "in" / one), *words)
    seconds = time.monotonic() - begun
    return seconds, {one: contents(work / "hand" / one) for one in names}


def run_fleet(work: Path, out: Path, *words: str) -> float:
    begun = time.monotonic()
    call("fleet", str(work / "in"), "-o", str(out), "--quiet", *words)
    return time.monotonic() - begun


def describe(
    what: str, out: Path, seconds: float, alone: float, by_hand: dict[str, dict[str, bytes]]
) -> list[str]:
    """A row of the table.

    Raises:
        RuntimeError: a temporary file is left.
    """
    files = {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()}
    left = {one for one in files - _OWN if not one.startswith(("results/", ".fleet/labels/"))}
    if left:
        raise RuntimeError(f"left behind: {sorted(left)}")
    same = sum(contents(out / "results" / one) == by_hand[one] for one in by_hand)
    listed = json.loads((out / "fleet.json").read_text())
    cpu = sum(one["cpu_seconds"] + one["inspect_cpu_seconds"] for one in listed)
    faster = f"{alone / seconds:.2f}" if alone else ""
    return [what, f"{seconds:.1f}", f"{cpu:.1f}", faster, f"{same} of {len(by_hand)}"]


@contextmanager
def start_cluster(work: Path) -> Iterator[Cluster]:
    """A scheduler and two workers of one thread each, as processes."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port = one.getsockname()[1]
    address, processes = f"tcp://127.0.0.1:{port}", []
    source = str(Path(__file__).resolve().parents[1] / "src")
    environment = {"PYTHONPATH": source, **os.environ}

    def run(name: str, *words: str) -> None:
        command = [sys.executable, "-m", f"distributed.cli.{name}", *words, "--no-dashboard"]
        processes.append(subprocess.Popen(command, cwd=work, env=environment, **_QUIET))

    try:
        run("dask_scheduler", "--host", "127.0.0.1", "--port", str(port))
        for _ in range(2):
            run("dask_worker", address, "--nthreads", "1", "--no-nanny")
        time.sleep(5)
        yield Cluster(address, [process.pid for process in processes[1:]])
    finally:
        for process in processes:
            process.kill()
            process.wait()


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
