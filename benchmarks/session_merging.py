"""`stillmap merge` and `stillmap map` as users call them, timed, and what became of sessions."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from place_poses import PoseScores, read_sessions, score_poses
from place_truth import load_session_truth

from stillmap.core.errors import InputError
from stillmap.core.se2 import inverse
from stillmap.results.reader import read_grid

_MAXRSS_UNIT = 1 if sys.platform == "darwin" else 1024  # bytes
STILLMAP = (sys.executable, "-m", "stillmap")
REFUSED = 2  # exit status: fewer than two sessions could be placed


@dataclass(frozen=True)
class Merged:
    """A merge: its folder, exit status, wall-clock and CPU seconds, its last words, and its peak of
    memory, bytes."""

    place: Path
    status: int
    seconds: float
    cpu: float
    words: str
    memory: int


def call(*words: object) -> Merged:
    """Run a command of stillmap with -o as its last word but one.

    Raises:
        RuntimeError: a defect: a status other than 0 and 2.
    """
    place = Path(str(words[-1]))
    place.parent.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(place, ignore_errors=True)
    started = time.perf_counter()
    with tempfile.TemporaryFile("w+") as errors:
        process = subprocess.Popen(
            [*STILLMAP, *map(str, words)], stdout=subprocess.DEVNULL, stderr=errors
        )
        _, status, used = os.wait4(process.pid, 0)  # of this child alone
        process.returncode = os.waitstatus_to_exitcode(status)
        seconds = time.perf_counter() - started
        errors.seek(0)
        said = errors.read()
    last = said.strip().splitlines()[-1:] or [""]
    if process.returncode not in (0, REFUSED):
        raise RuntimeError(f"{' '.join(map(str, words))}: {process.returncode}\n{said}")
    cpu, memory = used.ru_utime + used.ru_stime, used.ru_maxrss * _MAXRSS_UNIT
    return Merged(place, process.returncode, seconds, cpu, last[0], memory)


def merge(sessions: Sequence[Path], place: Path) -> Merged:
    """`stillmap merge SESSION... --threads 1 -o PLACE`."""
    return call("merge", *sessions, "--threads", 1, "-o", place)


def build_map(session: Path, result: Path) -> Merged:
    """`stillmap map SESSION --threads 1 -o RESULT`."""
    return call("map", session, "--threads", 1, "-o", result)


def poses_of(merged: Merged, truth_folder: Path) -> list[PoseScores]:
    """The scores of the poses of all sessions; none where the whole merge was refused."""
    if merged.status == REFUSED:
        return []
    truth = load_session_truth(truth_folder)
    try:
        return score_poses(read_sessions(merged.place, truth), truth)
    except InputError:
        return []


def folder_bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def known_m2(place: Path) -> float:
    """The area of the map of which anything is known."""
    grid = read_grid(place)
    return float(np.count_nonzero(~np.isnan(grid.p_occupied))) * grid.resolution**2


def largest_difference(one: Path, other: Path) -> float:
    """m, between the poses of two places, in the frame of the first session of each."""
    ours, theirs = (_poses(place) for place in (one, other))
    common = [name for name in ours if name in theirs]
    a, b = (inverse(poses[common[0]][0]) for poses in (ours, theirs))
    return max(
        float(np.linalg.norm((a @ ours[name] - b @ theirs[name])[:, :2, 2], axis=1).max())
        for name in common
    )


def _poses(place: Path) -> dict[str, np.ndarray]:
    from stillmap.results.eval.readers import read_trajectory

    names = [o["name"] for o in json.loads((place / "sessions.json").read_text()) if o["accepted"]]
    keep = np.array([0, 1, 3])
    read = {name: read_trajectory(place / f"sessions/{name}/trajectory.tum") for name in names}
    return {name: one.poses[:, keep[:, None], keep] for name, one in read.items()}


def labels_f1(one: Path, other: Path) -> float:
    """F1 of "dynamic" of the labels of one place against those of another."""
    both = both_or_either = 0
    names = [o["name"] for o in json.loads((one / "sessions.json").read_text()) if o["accepted"]]
    for name in names:
        files = [place / f"sessions/{name}/beams/p_static.npy" for place in (one, other)]
        if not files[1].exists():
            continue
        a, b = (np.load(file, mmap_mode="r") < 0.5 for file in files)
        both += 2 * int((a & b).sum())
        both_or_either += int(a.sum()) + int(b.sum())
    return both / both_or_either if both_or_either else float("nan")
