"""Arguments and outputs of `stillmap map` for tests."""

from pathlib import Path

QUICK = ("--set", "em.max_iterations=1")
TWO_ITERATIONS = ("--set", "em.max_iterations=2", "--set", "em.patience=9")
TWO_ITERATIONS += ("--set", "em.tolerance=0", "--set", "em.label_tolerance=0")
# goes on for long
ENDLESS = ("--set", "em.max_iterations=100000", "--set", "em.patience=100000")
ENDLESS += ("--set", "em.tolerance=0", "--set", "em.label_tolerance=0")
FILES = {
    "map.pgm",
    "map.yaml",
    "map.npz",
    "trajectory.tum",
    "report.html",
    "run.json",
    "beams/stamp_ns.npy",
    "beams/offset.npy",
    "beams/p_static.npy",
    "beams/hit.npy",
}


def list_files(folder: Path) -> set[str]:
    return {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}
