"""`stillmap map` with defaults on recorded logs: relation errors, CPU per scan, peak memory.

python benchmarks/real_logs.py FOLDER [LOG ...] [--keep DIR] [--karto-python PYTHON]
    [-- FLAGS FOR stillmap map]

FOLDER holds NAME.clf.gz with NAME.relations or NAME.pseudo.relations. Results go to a temporary
folder unless --keep names one. With --karto-python (see karto.py), Karto works on each log right
before and after stillmap, and the ratio of the CPU times is printed.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path

import karto
import numpy as np
from common import timed
from pairs import relations_beside

from stillmap import read


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("folder", type=Path)
    p.add_argument("logs", nargs="*")
    p.add_argument("--keep", type=Path)
    p.add_argument("--karto-python")
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
            before = karto_cpu(args.folder, log, args.karto_python)
            text, cpu = row(args.folder, log, out, flags)
            after = karto_cpu(args.folder, log, args.karto_python)
            if args.karto_python:
                text += f" | {2.0 * cpu / (before + after):.2f} x Karto"
            print(text, flush=True)


def split(argv: list[str]) -> tuple[list[str], list[str]]:
    at = argv.index("--") if "--" in argv else len(argv)
    return argv[:at], argv[at + 1 :]


def karto_cpu(folder: Path, log: str, python: str | None) -> float:
    """CPU seconds of Karto's whole process; NaN: not asked for."""
    if python is None:
        return float("nan")
    return karto.mapped(read(folder / f"{log}.clf.gz"), python).process_cpu


def row(folder: Path, log: str, out: Path, flags: list[str]) -> tuple[str, float]:
    """What is printed about a log, and the CPU seconds of the whole job."""
    path = folder / f"{log}.clf.gz"
    _, cpu = stillmap("map", str(path), "-o", str(out), "--overwrite", "--quiet", *flags)
    run = json.loads((out / "run.json").read_text())
    trajectory, relations = str(out / "trajectory.tum"), str(relations_beside(path))
    o = json.loads(stillmap("eval", "relations", trajectory, relations, "--json")[0])
    p_static, hit = (np.load(out / "beams" / f"{name}.npy") for name in ("p_static", "hit"))
    scans = run["counts"]["scans"]
    registration = run["cpu_seconds"]["m_step"] / len(run["iterations"])
    text = (
        f"{log:10} | {scans:5} | {o['translation']['mean']:.4f} "
        f"({o['translation']['median']:.4f}, {o['translation']['max']:.3f}) | "
        f"{o['rotation']['mean']:.3f} | {o['used']:4} | "
        f"{100 * np.mean(p_static[hit] < 0.5):.1f} % | "
        f"{len(run['iterations'])} ({run['best_iteration']}) | "
        f"{1e3 * registration / scans:.2f} per iteration, {1e3 * cpu / scans:.2f} in all | "
        f"{max(run['peak_memory_bytes'].values()) / 1e6:.0f}"
    )
    return text, cpu


def stillmap(*arguments: str) -> tuple[str, float]:
    """What a command prints, and its CPU seconds."""
    return timed([sys.executable, "-m", "stillmap", *arguments])


if __name__ == "__main__":
    main()
