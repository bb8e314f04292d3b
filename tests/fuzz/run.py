"""Fuzzes the readers one after the other, up to the first finding, whose input is kept.

python tests/fuzz/run.py              60 s each
python tests/fuzz/run.py 600 bag e57  ten minutes each, these two
"""

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

# libe57 keeps 2 MB for each scan whose packets are damaged
MAX_INPUTS = {"e57": 10_000}
HERE = Path(__file__).resolve().parent
FOUND = HERE.parent.parent / "build" / "fuzz"
NAMES = (
    *("carmen", "stillmap", "bag", "mcap", "db3", "ros1", "cdr", "kitti", "drive", "pcd", "ply"),
    *("las", "e57", "3dtk", "scenes", "tum", "cameras", "toml", "rows", "result"),
)


def main(words: list[str]) -> int:
    """Returns the exit status: 1 after a finding."""
    seconds = int(words[0]) if words else 60
    FOUND.mkdir(parents=True, exist_ok=True)
    print(f"{'reader':<8} {'inputs':>8} {'coverage':>13} {'peak MB':>8}")
    for name in words[1:] or NAMES:
        if not _fuzz(name, seconds):
            return 1
    return 0


def _fuzz(name: str, seconds: int) -> bool:
    """Fuzz one reader in a process of its own; returns whether nothing was found."""
    log = FOUND / f"{name}.log"
    options = [f"-max_total_time={seconds}", f"-artifact_prefix={FOUND}/{name}-"]
    options.append(f"-runs={MAX_INPUTS.get(name, -1)}")
    shm = Path("/dev/shm")
    with (
        tempfile.TemporaryDirectory(dir=shm if shm.is_dir() else None) as folder,
        log.open("wb") as file,
    ):
        # OpenBLAS reserves memory for every possible thread
        variables = {"TMPDIR": folder, "OPENBLAS_NUM_THREADS": "1"}
        process = subprocess.Popen(
            [sys.executable, str(HERE / "one.py"), name, *options, "-print_final_stats=1"],
            stdout=file,
            stderr=subprocess.STDOUT,
            env=os.environ | variables,
        )
        _, state, used = os.wait4(process.pid, 0)
    text = log.read_text("utf-8", "replace")
    inputs = re.findall(r"number_of_executed_units: (\d+)", text)[-1:] or ["0"]
    covered = re.findall(r" cov: (\d+) ", text)
    grown = f"{covered[0]} > {covered[-1]}" if covered else "?"
    print(f"{name:<8} {inputs[0]:>8} {grown:>13} {used.ru_maxrss >> 10:>8}", flush=True)
    if os.waitstatus_to_exitcode(state) == 0:
        return True
    where = re.findall(r"Test unit written to (.*)", text)
    print(f"found: {where[-1] if where else 'no input'}, see {log}", file=sys.stderr)
    if where:
        print(f"again: {sys.executable} {HERE / 'one.py'} {name} {where[-1]}", file=sys.stderr)
    return False


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
