"""Compares what two commits of stillmap compute from the same recordings, to the bit.

`make same BASE=<commit>` runs it: that commit is built in `build/same`, the work tree in `.venv`.
Recordings come from the base's simulator and, where it is, from `../shared/data`.
"""

import argparse
import json
import math
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT.parent / "shared/data"
# what differs from run to run, or is not a result
IGNORED_KEYS = {
    *("seconds", "peak_memory_bytes", "version", "format_version", "input", "options", "warnings"),
    *("latency_ms", "cpu_seconds", "memory", "output", "path", "source", "recording", "created"),
}
ARRAYS, BYTES = {".npy", ".npz"}, {".pgm", ".yaml", ".tum", ".g2o", ".ply", ".bag", ".log", ".pcd"}

# input name -> words of `simulate`, or a path below ../shared/data
SIMULATED = {
    "hall": "hall --scans 250 --seed 3",
    "office": "office --scans 300 --seed 4",
    "corridor": "corridor --scans 300 --seed 5 --shape legs",
    "street": "street --lidar 16 --scans 25 --seed 6",
    "crossing": "crossing --lidar 32 --scans 12 --seed 7 --camera",
    "tilting": "hall --lidar tilting --rate 37.5 --scans 400 --seed 8",
    "days": "office --scans 200 --sessions 2 --seed 9",
}
RECORDED = {
    "belgioioso": "laser2d/belgioioso.clf.gz",
    "seattle": "laser2d/seattle.clf.gz",
    "bag": "people/people_1.bag",
    "rgbd": "rgbd/kitchenette",
}
# case -> words of the command; {name} is an input, {out} the folder written
CASES = {
    **{name: f"map {{{name}}} -o {{out}}" for name in ("hall", "office", "corridor", "street")},
    "crossing": "map {crossing} -o {out} --no-mesh",
    "belgioioso": "map {belgioioso} -o {out} --set em.max_iterations=2",
    "seattle": "map {seattle} -o {out} --set em.max_iterations=2 --no-odometry",
    "bag": "map {bag} -o {out} --to 30",
    "rgbd": "map {rgbd} -o {out} --poses recording --no-mesh --to 2 --set em.max_iterations=2",
    "tilting": "map {tilting}/horizontal --tilting {tilting}/tilting -o {out} --no-mesh",
    "merge": "merge {days}/session-1 {days}/session-2 -o {out} --set em.max_iterations=2",
    "live": "live --replay {hall} -o {out}",
    "live3d": "live --replay {street} -o {out}",
}


def main() -> int:
    """Run every case with both versions; 1 where an array or number differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("base", help="the commit to compare with")
    parser.add_argument("--base-python", help="a Python with the base installed: nothing is built")
    parser.add_argument("--cases", help=f"some of {','.join(['simulate', *CASES])}")
    parser.add_argument("--work", type=Path, default=ROOT / "build/same")
    chosen = parser.parse_args()
    work = (chosen.work / chosen.base).resolve()
    work.mkdir(parents=True, exist_ok=True)
    base_python = chosen.base_python or build(chosen.base, work)
    names = chosen.cases.split(",") if chosen.cases else ["simulate", *CASES]
    differences = 0
    for name in names:
        rows = list(compare_case(name, base_python, work))
        differences += sum(not row.startswith("only ") for row in rows)
        print(f"{name}: {'; '.join(rows) or 'the same'}", flush=True)
    print(f"{len(names)} cases, {differences} differences")
    return int(differences > 0)


def build(commit: str, work: Path) -> str:
    """Build a commit with the tools of this environment; the Python that has it."""
    python = work / "venv/bin/python"
    if (work / "built").exists():
        return str(python)
    tree = work / "tree"
    tree.mkdir(exist_ok=True)
    archive = subprocess.run(
        ["git", "-C", str(ROOT), "archive", commit], check=True, stdout=subprocess.PIPE
    )
    subprocess.run(["tar", "-x", "-C", str(tree)], input=archive.stdout, check=True)
    subprocess.run([sys.executable, "-m", "venv", "--clear", str(work / "venv")], check=True)
    # dependencies that both have are those of this environment
    (site,) = (work / "venv").glob("lib/python*/site-packages")
    (own,) = (path for path in sys.path if path.endswith("site-packages"))
    (site / "shared.pth").write_text(own + "\n")
    pip = [str(python), "-m", "pip", "install", "--quiet", "--no-build-isolation"]
    subprocess.run([*pip, "--force-reinstall", "--no-deps", str(tree)], check=True)
    subprocess.run([*pip, str(tree)], check=True)
    (work / "built").touch()
    return str(python)


def compare_case(name: str, base_python: str, work: Path) -> Iterator[str]:
    """What differs between both versions of one case."""
    if name == "simulate":
        for scene, words in SIMULATED.items():
            new = work / "new/simulate" / scene
            run(sys.executable, f"simulate {words} -o {new} --overwrite --quiet", work)
            yield from compare_folders(simulated(scene, base_python, work), new, f"{scene}/")
        return
    inputs = {}
    for key in (*SIMULATED, *RECORDED):
        if f"{{{key}}}" not in CASES[name]:
            continue
        inputs[key] = (
            simulated(key, base_python, work) if key in SIMULATED else DATA / RECORDED[key]
        )
        if not inputs[key].exists():
            yield f"only with {inputs[key]}: skipped"
            return
    folders = []
    for version, python in (("base", base_python), ("new", sys.executable)):
        out = work / version / name
        if version == "new" or not out.exists():
            words = CASES[name].format(**inputs, out=out)
            run(python, f"{words} --overwrite --quiet", work)
        folders.append(out)
    yield from compare_folders(*folders)


def simulated(scene: str, base_python: str, work: Path) -> Path:
    """The recording of a scene by the base's simulator."""
    folder = work / "inputs" / scene
    if not folder.exists():
        run(base_python, f"simulate {SIMULATED[scene]} -o {folder} --quiet", work)
    return folder


def run(python: str, words: str, folder: Path) -> None:
    """Run a command of stillmap; SystemExit where it fails."""
    command = [*python.split(), "-m", "stillmap", *words.split()]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}\n{done.stderr}")


def compare_folders(base: Path, new: Path, prefix: str = "") -> Iterator[str]:
    """What differs between the files of two folders."""
    files = [
        {str(path.relative_to(top)) for path in top.rglob("*") if path.is_file()}
        for top in (base, new)
    ]
    for words, names in (("base", files[0] - files[1]), ("work tree", files[1] - files[0])):
        if names:
            shown = ", ".join(prefix + name for name in sorted(names)[:8])
            yield f"only in the {words}: {shown}{' ...' if len(names) > 8 else ''}"
    for name in sorted(files[0] & files[1]):
        for row in compare_files(base / name, new / name):
            yield f"{prefix}{name} {row}"


def compare_files(base: Path, new: Path) -> Iterator[str]:
    """What differs between two files of the same name."""
    kind = base.suffix
    if kind in ARRAYS:
        loaded = [np.load(path, allow_pickle=False) for path in (base, new)]
        parts: list[Any] = [part if kind == ".npz" else {"": part} for part in loaded]
        for key in sorted(set(parts[0]) & set(parts[1])):
            yield from compare_arrays(key, parts[0][key], parts[1][key])
    elif kind == ".json":
        yield from compare_json("", *(json.loads(path.read_text()) for path in (base, new)))
    elif kind in BYTES and base.read_bytes() != new.read_bytes():
        yield "differs"


def compare_arrays(key: str, base: Any, new: Any) -> Iterator[str]:
    """What differs between two arrays, NaN being equal to NaN."""
    if base.shape != new.shape or base.dtype != new.dtype:
        yield f"{key} is {new.shape} {new.dtype} instead of {base.shape} {base.dtype}"
    elif base.tobytes() != new.tobytes():
        differs = ~((base == new) | ((base != base) & (new != new)))
        if differs.any() and base.dtype.kind in "fiu":
            largest = np.nanmax(np.abs(base.astype(float) - new.astype(float)))
            yield f"{key} differs in {differs.sum()} of {base.size}, by up to {largest:.3g}"
        elif differs.any():
            yield f"{key} differs in {differs.sum()} of {base.size}"


def compare_json(where: str, base: Any, new: Any) -> Iterator[str]:
    """Values that differ below the keys that both have."""
    same: Callable[[Any, Any], bool] = lambda a, b: a == b or (a != a and b != b)  # noqa: E731
    if isinstance(base, dict) and isinstance(new, dict):
        for key in sorted(set(base) & set(new) - IGNORED_KEYS):
            yield from compare_json(f"{where}.{key}", base[key], new[key])
    elif isinstance(base, list) and isinstance(new, list) and len(base) == len(new):
        for number, pair in enumerate(zip(base, new, strict=True)):
            yield from compare_json(f"{where}[{number}]", *pair)
    elif not same(base, new) and not isinstance(base, str):
        words = (base, new) if all(map(is_scalar, (base, new))) else ("something", "else")
        yield f"{where} is {words[1]} instead of {words[0]}"


def is_scalar(value: Any) -> bool:
    """True for what fits into a message."""
    return value is None or (isinstance(value, int | float) and math.isfinite(value))


if __name__ == "__main__":
    sys.exit(main())
