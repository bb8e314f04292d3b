"""`stillmap map` with defaults on recorded logs: relation errors, CPU per scan, peak memory.

python benchmarks/real_logs.py FOLDER [LOG ...] [--keep DIR] [-- FLAGS FOR stillmap map]

FOLDER holds NAME.clf.gz with NAME.relations or NAME.pseudo.relations. Results go to a temporary
folder unless --keep names one. Karto beside it: peers.py.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path

import numpy as np
from common import timed
from pairs import relations_beside


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("folder", type=Path)
    p.add_argument("logs", nargs="*")
    p.add_argument("--keep", type=Path)
    own, flags = split(sys.argv[1:])
    args = p.parse_args(own)
    logs = args.logs or sorted(f.name.removesuffix(".clf.gz") for f in args.folder.glob("*.clf.gz"))
    print(
        "log        | scans | trans m (median, max)   | rot deg | used | dynamic | it (best) |"
        " CPU ms/scan: registration + rest | peak MB"
    )
    with tempfile.TemporaryDirectory() as scratch:
        for log in logs:
            out = (args.keep or Path(scratch)) / log
            print(row(args.folder, log, out, flags), flush=True)


def split(argv: list[str]) -> tuple[list[str], list[str]]:
    at = argv.index("--") if "--" in argv else len(argv)
    return argv[:at], argv[at + 1 :]


def row(folder: Path, log: str, out: Path, flags: list[str]) -> str:
    """What is printed about a log."""
    path = folder / f"{log}.clf.gz"
    _, cpu = stillmap("map", str(path), "-o", str(out), "--overwrite", "--quiet", *flags)
    run = json.loads((out / "run.json").read_text())
    trajectory, relations = str(out / "trajectory.tum"), str(relations_beside(path))
    o = json.loads(stillmap("eval", "relations", trajectory, relations, "--json")[0])
    p_static, hit = (np.load(out / "beams" / f"{name}.npy") for name in ("p_static", "hit"))
    scans = run["counts"]["scans"]
    registration = run["cpu_seconds"]["m_step"] / len(run["iterations"])
    return (
        f"{log:10} | {scans:5} | {o['translation']['mean']:.4f} "
        f"({o['translation']['median']:.4f}, {o['translation']['max']:.3f}) | "
        f"{o['rotation']['mean']:.3f} | {o['used']:4} | "
        f"{100 * np.mean(p_static[hit] < 0.5):.1f} % | "
        f"{len(run['iterations'])} ({run['best_iteration']}) | "
        f"{1e3 * registration / scans:.2f} per iteration, {1e3 * cpu / scans:.2f} in all | "
        f"{max(run['peak_memory_bytes'].values()) / 1e6:.0f}"
    )


def stillmap(*arguments: str) -> tuple[str, float]:
    """What a command prints, and its CPU seconds."""
    return timed([sys.executable, "-m", "stillmap", *arguments])


if __name__ == "__main__":
    main()
