"""Live mapping for hours: latency and memory while a recording is driven to and fro.

python benchmarks/live_hours.py RECORDING [--hours 1] [--rate 1] [--max-scratch 1e9]

The recording is pushed forwards, backwards, forwards and so on, which is one drive: poses and
odometry are continuous, people turn round. Scans come at `rate` times their own speed, 0: as fast
as possible; loops are closed in a process of their own. A latency counts from when a scan is due.
What an answer need not wait for is done after it, before the next scan is waited for.
Prints a line for each tenth: latencies, scans that came late, MB of this process without the
recording, of the other one, and of both, in which the libraries that both have mapped count once.
"""

import argparse
import time
from array import array
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from tables import markdown

import stillmap
from stillmap.live.mapper import LiveMapper
from stillmap.live.replay import iter_beams

_TITLES = ("minutes", "scans", "ms: median", "99 %", "max", "late", "MB", "MB of loops", "both")


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("recording", type=Path)
    p.add_argument("--hours", type=float, default=1.0)
    p.add_argument("--rate", type=float, default=1.0)
    p.add_argument("--max-scratch", type=float)
    args = p.parse_args()
    begin = _resident_mb("self")
    recording = stillmap.read(args.recording)
    beams = list(iter_beams(recording))
    odometry = recording.T_odom_base
    steps = np.diff(recording.stamp_ns)
    period = float(np.median(steps))
    count = round(3600e9 * args.hours / period)
    limit = None if args.max_scratch is None else int(args.max_scratch)
    of_recording, lines, late = _resident_mb("self") - begin, [], 0
    ms = array("f")  # a list of numbers would take 11 MB in ten hours
    every = -(-count // 10)
    with LiveMapper({"threads": 2}, background=True, max_scratch=limit) as mapper:
        start = time.perf_counter()
        for n in range(count):
            t = _to_and_fro(n, len(beams))
            stamp_ns = round(n * period)
            due = start + 1e-9 * stamp_ns / args.rate if args.rate else time.perf_counter()
            late += args.rate > 0 and time.perf_counter() > due + 1e-9 * period / args.rate
            time.sleep(max(due - time.perf_counter(), 0.0))
            scan = replace(beams[t], stamp_ns=stamp_ns)
            mapper.push(scan, None if odometry is None else odometry[t])
            ms.append(1e3 * (time.perf_counter() - due))
            mapper.update_map()
            if (n + 1) % every == 0 or n + 1 == count:
                child = str(mapper._slam.frame._closer._process.pid)
                memory = _memory(child, of_recording)
                lines.append([*_line(n + 1, period, ms[-every:], late), *memory])
                print(" | ".join(lines[-1]), flush=True)
    lines.append(["all", *_line(count, period, ms, late)[1:], *lines[-1][-3:]])
    print(markdown(list(_TITLES), lines))


def _to_and_fro(n: int, count: int) -> int:
    """Index of the n-th scan of a drive to and fro over `count` scans."""
    k = n % (2 * count)
    return k if k < count else 2 * count - 1 - k


def _line(n: int, period: float, ms: Sequence[float], late: int) -> list[str]:
    quantiles = (np.median(ms), np.quantile(ms, 0.99), np.max(ms))
    return [f"{n * period / 60e9:.0f}", str(n), *(f"{q:.1f}" for q in quantiles), str(late)]


def _memory(child: str, of_recording: float) -> list[str]:
    own, other = _resident_mb("self") - of_recording, _resident_mb(child)
    ours, theirs = _mapped_mb("self"), _mapped_mb(child)
    shared = sum(min(ours[path], theirs[path]) for path in ours.keys() & theirs.keys())
    return [f"{mb:.0f}" for mb in (own, other, own + other - shared)]


def _resident_mb(pid: str) -> float:
    """Resident memory of a process now."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * 4096 / 2**20


def _mapped_mb(pid: str) -> Counter[str]:
    """Resident memory of a process by the files that it has mapped, without what it has changed."""
    out, path = Counter[str](), ""
    for line in Path(f"/proc/{pid}/smaps").read_text().splitlines():
        name, *words = line.split()
        if not name.endswith(":"):  # the begin of a mapping
            path = words[4] if len(words) > 4 and words[4].startswith("/") else ""
        elif path and name in ("Shared_Clean:", "Private_Clean:"):
            out[path] += int(words[0]) / 1024
    return out


if __name__ == "__main__":
    main()
