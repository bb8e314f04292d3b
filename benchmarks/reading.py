"""How fast recordings are read, and how much of a run that is.

python benchmarks/reading.py [--scans 20000] [--beams 1081] [--repeats 5] [--run]

Writes random scans of a laser in every form into a temporary folder and reads them in turn, several
times; medians of the CPU time. "messages": the messages are decoded and their readings gathered, as
`stillmap.recording.read` does it first; "read": all of it, until beams lie in the recording.
`--run` maps a simulated hall from each form instead and gives the share of reading in the whole.
"""

import argparse
import statistics
import tempfile
import time
from pathlib import Path

import numpy as np
from tables import markdown

from stillmap.core.profiling import StageTimer
from stillmap.core.recording import Recording
from stillmap.io import read, writers
from stillmap.io.builder import ReadContext
from stillmap.io.ros.bag import open_bag
from stillmap.io.ros.messages import ENDINGS
from stillmap.io.ros.reader import collect_messages, select_topics
from stillmap.pipeline.result import map_recording
from stillmap.prepare.options import ReadOptions
from stillmap.sim import scene_by_name, simulate

FORMS = (".bag", ".db3", ".mcap", ".log", ".log.gz", "")
WANTED = 40_000  # scans of 1081 beams per second
WANTED_SHARE = 0.15


def main() -> None:
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("--scans", type=int, default=20_000)
    p.add_argument("--beams", type=int, default=1081)
    p.add_argument("--repeats", type=int, default=5)
    p.add_argument("--forms", nargs="+", default=list(FORMS))
    p.add_argument("--run", action="store_true")
    args = p.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        recording = _hall() if args.run else _random(args.scans, args.beams)
        paths = [Path(folder) / f"scans{ending}" for ending in args.forms]
        for path in paths:
            writers.write(recording, path)
        print(_shares(paths) if args.run else _speeds(paths, recording.n_scans, args.repeats))


def _random(scans: int, beams: int) -> Recording:
    rng = np.random.default_rng(1)
    angle = np.linspace(-2.35, 2.35, beams)
    length = rng.uniform(1.0, 20.0, (scans, beams, 1))
    points = length * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return Recording(
        stamp_ns=10**18 + np.arange(scans, dtype=np.int64) * 25_000_000,
        offset=np.arange(scans + 1, dtype=np.int64) * beams,
        points=points.reshape(-1, 2).astype(np.float32),
        hit=np.ones(scans * beams, np.bool_),
        T_base_sensor=np.eye(3)[None],
        sensor=np.zeros(scans, np.int32),
        T_odom_base=None,
    )


def _hall() -> Recording:
    return simulate(scene_by_name("hall"), np.random.default_rng(0)).recording


def _speeds(paths: list[Path], scans: int, repeats: int) -> str:
    messages: dict[Path, list[float]] = {path: [] for path in paths}
    whole: dict[Path, list[float]] = {path: [] for path in paths}
    for _ in range(repeats):
        for path in paths:
            if path.suffix in ENDINGS:
                started = time.process_time()
                _gathered(path)
                messages[path].append(time.process_time() - started)
            started = time.process_time()
            read(path)
            whole[path].append(time.process_time() - started)
    rows = []
    for path in paths:
        decoded = f"{scans / statistics.median(messages[path]):.0f}" if messages[path] else "-"
        rows.append([path.name, decoded, f"{scans / statistics.median(whole[path]):.0f}"])
    return markdown(["form", "messages/s", "scans/s, read"], rows)


def _gathered(path: Path) -> None:
    bag, context = open_bag(path, None, trusted=True), ReadContext(ReadOptions())
    collect_messages(bag, select_topics(bag, context.options), context)
    bag.close()


def _shares(paths: list[Path]) -> str:
    rows = []
    for path in paths:
        stages = StageTimer()
        with stages.measure("read"):
            recording = read(path)
        map_recording(recording, stages=stages)
        cpu = {name: stage["cpu_seconds"] for name, stage in stages.to_dict().items()}
        share = cpu["read"] / sum(cpu.values())
        rows.append([path.name, f"{cpu['read']:.2f}", f"{100.0 * share:.1f} %"])
    return markdown(["form", "reading, CPU s", f"of the run (at most {WANTED_SHARE:.0%})"], rows)


if __name__ == "__main__":
    main()
