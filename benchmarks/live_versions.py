"""Live mapping by two versions of stillmap in turn: CPU time of an answer, and whether it differs.

python benchmarks/live_versions.py RECORDING SRC_BEFORE SRC_AFTER [--scans 1500]

SRC: folders `src` of two checkouts, each with its built kernels. Both get 50 scans in turn, so that
other jobs on the machine slow both down. What an answer need not wait for (`update_map`) does not
count where a version has it. Prints milliseconds of CPU of `push`, and what of the answers differs.
"""

import argparse
import hashlib
import itertools
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from tables import markdown

_IN_TURN = 50  # scans


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("recording", type=Path)
    p.add_argument("before", type=Path)
    p.add_argument("after", type=Path, nargs="?")
    p.add_argument("--scans", type=int, default=1500)
    args = p.parse_args()
    if args.after is None:  # the version that is imported, for the process that compares
        push_when_told(args.recording)
        return
    versions = [start(args.recording, src) for src in (args.before, args.after)]
    ms: list[list[float]] = [[], []]
    for first in range(0, args.scans, _IN_TURN):
        order = (0, 1) if first // _IN_TURN % 2 == 0 else (1, 0)
        for k in order:
            ms[k] += map(float, tell(versions[k], min(_IN_TURN, args.scans - first)))
    digests = [tell(one, 0) for one in versions]
    before, after = (np.array(one) for one in ms)
    lines = [
        [name, *(f"{x:.2f}" for x in (np.median(a), np.quantile(a, 0.99), a.max()))]
        for name, a in (("before", before), ("after", after))
    ]
    print(markdown(["version", "median ms", "99 %", "max"], lines))
    different = [one.split(":")[0] for one in set(digests[0]) ^ set(digests[1])]
    ratio = float(np.median(after / before))
    print(f"median ratio {ratio:.2f}; different: {', '.join(sorted(set(different))) or 'nothing'}")


def start(recording: Path, src: Path) -> "subprocess.Popen[str]":
    """A process that pushes scans by the version in a folder."""
    environment = {**os.environ, "PYTHONPATH": str(src.resolve()), "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, __file__, str(recording), str(src)]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, stdin=pipe, stdout=pipe, env=environment, text=True)


def tell(version: "subprocess.Popen[str]", scans: int) -> list[str]:
    """Let a version push so many scans; 0: end it."""
    assert version.stdin is not None
    assert version.stdout is not None
    version.stdin.write(f"{scans}\n")
    version.stdin.flush()
    return version.stdout.readline().split()


def push_when_told(path: Path) -> None:
    import stillmap
    from stillmap.live.mapper import LiveMapper
    from stillmap.live.replay import iter_beams

    recording = stillmap.read(path)
    scans, odometry = enumerate(iter_beams(recording)), recording.T_odom_base
    digests = {name: hashlib.sha256() for name in ("pose", "p_static", "changes", "movers")}
    with LiveMapper({"threads": 1}) as mapper:
        for count in map(int, iter(sys.stdin.readline, "0\n")):
            ms = []
            for t, beams in itertools.islice(scans, count):
                began = time.thread_time()
                update = mapper.push(beams, None if odometry is None else odometry[t])
                ms.append(1e3 * (time.thread_time() - began))
                note(digests, update)
                if hasattr(mapper, "update_map"):
                    mapper.update_map()
            print(*(f"{x:.4f}" for x in ms), flush=True)
        digests["map"] = hashlib.sha256(mapper.map.p_occupied.tobytes())
        digests["poses"] = hashlib.sha256(mapper.poses.tobytes())
    print(*(f"{name}:{one.hexdigest()}" for name, one in digests.items()), flush=True)


def note(digests: dict[str, Any], update: Any) -> None:
    """Add an answer to the digests."""
    digests["pose"].update(update.pose.tobytes() + update.covariance.tobytes())
    digests["p_static"].update(update.p_static.tobytes())
    for change in update.changes:
        digests["changes"].update(change.first_cell.tobytes() + change.p_occupied.tobytes())
    for mover in update.movers:
        digests["movers"].update(mover.position.tobytes() + mover.covariance.tobytes())


if __name__ == "__main__":
    main()
