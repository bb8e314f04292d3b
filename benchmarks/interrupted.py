"""Are results the same however often a run is killed, and does a full disk cost anything?

python benchmarks/interrupted.py [--recording FILE] [--kills 50] [--full 20] [--seed 0]
    [--set section.key=value ...]

Kills: `stillmap map --resume` is killed (SIGKILL) after a random time, again and again, five times
at most until it is left to itself; every result is compared, file by file, with one of a run that
nobody stopped. Full: the same on a file system
of its own (a tmpfs, which takes root to mount) of ever another size, too small for the job; then
the disk is made large enough, and the run goes on.
"""

import argparse
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from tables import markdown

_KILLS_EACH = 5  # of one result
_LARGE = 1 << 30  # bytes, more than any of these results


def main() -> None:
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("--recording", type=Path, help="default: a simulated hall of 300 scans")
    p.add_argument("--kills", type=int, default=50)
    p.add_argument("--full", type=int, default=20)
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    args = p.parse_args()
    rng = random.Random(args.seed)
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        recording = args.recording or simulated(work / "hall")
        words = [str(recording), *(word for one in args.set for word in ("--set", one))]
        begun = time.monotonic()
        run(work / "whole", words)
        seconds = time.monotonic() - begun
        whole = contents(work / "whole")
        rows = [killed(work, words, whole, args.kills, seconds, rng)]
        if args.full and os.geteuid() == 0:
            rows.append(on_full_disks(work, words, whole, args.full, rng))
    print(markdown(["what", "times", "runs that ended", "with the same bytes"], rows))


def simulated(path: Path) -> Path:
    """A recording to map."""
    command = [sys.executable, "-m", "stillmap", "simulate", "hall", "-o", str(path)]
    subprocess.run([*command, "--set", "robot.scans=300"], check=True, capture_output=True)
    return path


def command(out: Path, words: Sequence[str], *more: str) -> list[str]:
    return [sys.executable, "-m", "stillmap", "map", *words, "-o", str(out), "--quiet", *more]


def run(out: Path, words: Sequence[str], *more: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command(out, words, *more), capture_output=True, text=True)


def contents(folder: Path) -> dict[str, bytes]:
    """All files, without what tells of time and memory in them."""
    out = {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    record = json.loads(out["run.json"])
    for name in ("seconds", "cpu_seconds", "peak_memory_bytes"):
        del record[name]
    for iteration in record["iterations"]:
        del iteration["seconds"]
    report = re.sub(rb"<h3>Time and memory</h3>.*?</details>", b"", out["report.html"], flags=re.S)
    report = re.sub(rb"<div><dt>(Computed in|Peak memory)</dt>.*?</div>", b"", report)
    report = re.sub(rb"<td[^<>]*>[0-9.,]+ (ms|s|min)</td>", b"", report)
    return {**out, "run.json": json.dumps(record).encode(), "report.html": report}


def killed(
    work: Path,
    words: Sequence[str],
    whole: dict[str, bytes],
    kills: int,
    seconds: float,
    rng: random.Random,
) -> list[str]:
    """Kills until there were so many; each time a run ends, its result is looked at and goes."""
    out, ended, same, done, of_this = work / "killed", 0, 0, 0, 0
    while done < kills or of_this:
        spared = done == kills or of_this == _KILLS_EACH
        process = subprocess.Popen(
            command(out, words, "--resume"), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
        )
        try:
            process.wait(None if spared else rng.uniform(0.3, seconds))
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            done, of_this = done + 1, of_this + 1
        _, err = process.communicate()
        if process.returncode not in (0, -signal.SIGKILL):
            raise RuntimeError(err.decode())
        if process.returncode == 0:
            ended, of_this = ended + 1, 0
            same += contents(out) == whole
            left = sorted(path.name for path in work.iterdir() if "killed" in path.name)
            if left != ["killed"]:
                raise RuntimeError(f"left behind: {left}")
            shutil.rmtree(out)
    return ["killed", str(done), str(ended), str(same)]


def on_full_disks(
    work: Path, words: Sequence[str], whole: dict[str, bytes], times: int, rng: random.Random
) -> list[str]:
    """Disks of random sizes below what is needed; then room is made and the run goes on."""
    disk, ended, same = work / "disk", 0, 0
    disk.mkdir()
    need = sum(len(data) for data in whole.values())
    for number in range(times):
        size = rng.randrange(1 << 16, 2 * need) if number else 1 << 14
        _mount(disk, size, "-t", "tmpfs")
        try:
            old = disk / "out" / "old.txt"
            old.parent.mkdir()
            old.write_text("old")
            done = run(disk / "out", words, "--overwrite")
            if done.returncode == 0:
                same -= contents(disk / "out") != whole
                shutil.rmtree(disk / "out")
            elif done.returncode != 2 or done.stderr.count("\n") != 1 or not old.exists():
                raise RuntimeError(f"status {done.returncode}: {done.stderr}")
            _mount(disk, _LARGE, "-o", "remount")
            done = run(disk / "out", words, "--resume")
            if done.returncode:
                raise RuntimeError(done.stderr)
            ended += 1
            same += contents(disk / "out") == whole
        finally:
            subprocess.run(["umount", str(disk)], check=True)
    return ["disk full", str(times), str(ended), str(same)]


def _mount(disk: Path, size: int, *how: str) -> None:
    subprocess.run(["mount", *how, "-o", f"size={size}", "tmpfs", str(disk)], check=True)


if __name__ == "__main__":
    main()
