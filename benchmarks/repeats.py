"""One recording again and again in one process: memory and open files after each time.

python benchmarks/repeats.py RECORDING [--times 20] [--live]

It is read, mapped, saved, loaded again and thrown away; with --live pushed scan by scan, as fast
as possible, through a `stillmap.LiveMapper` that closes loops in a process of its own, and saved.
Prints a line for each time: seconds of CPU, then what is held after a garbage collection: resident
MB, the numbers of objects that it follows, open files, threads and child processes.
"""

import argparse
import gc
import os
import resource
import tempfile
from pathlib import Path

from tables import markdown

import stillmap
from stillmap.core.parallel import trim_heap
from stillmap.live.replay import iter_beams

OPTIONS = {"threads": 1}
_TITLES = ("time", "CPU s", "MB", "objects", "open files", "threads", "children")


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("recording", type=Path)
    p.add_argument("--times", type=int, default=20)
    p.add_argument("--live", action="store_true")
    args = p.parse_args()
    once = drive_once if args.live else map_once
    lines = [line(0)]
    for n in range(args.times):
        with tempfile.TemporaryDirectory() as folder:
            once(args.recording, Path(folder) / "map")
        lines.append(line(n + 1))
        print(" | ".join(lines[-1]), flush=True)
    print(markdown(list(_TITLES), [list(one) for one in lines]))


def map_once(recording: Path, out: Path) -> None:
    stillmap.build(recording, OPTIONS).save(out)
    loaded = stillmap.load(out)
    assert len(loaded.deskewed.points) == len(loaded.p_static)


def drive_once(path: Path, out: Path) -> None:
    recording = stillmap.read(path)
    odometry = recording.T_odom_base
    with stillmap.LiveMapper(OPTIONS, background=True) as mapper:
        for t, beams in enumerate(iter_beams(recording)):
            mapper.push(beams, None if odometry is None else odometry[t])
        mapper.save(out)


def line(n: int) -> tuple[str, ...]:
    """What this process holds now."""
    gc.collect()
    trim_heap()
    used = resource.getrusage(resource.RUSAGE_SELF)
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    children = Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()
    numbers = (
        *(len(gc.get_objects()), len(os.listdir("/proc/self/fd"))),
        *(len(os.listdir("/proc/self/task")), len(children)),
    )
    seconds, size = used.ru_utime + used.ru_stime, pages * resource.getpagesize() / 2**20
    return (str(n), f"{seconds:.1f}", f"{size:.1f}", *map(str, numbers))


if __name__ == "__main__":
    main()
