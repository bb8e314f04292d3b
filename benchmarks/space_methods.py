"""One method on one prepared case: its labels to the disk, and what it cost.

Each runs in a process of its own, so that its peak memory is its own. Reading from the disk is
counted for everybody.
"""

import json
import os
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from common import Scores

import stillmap
from stillmap.core import config
from stillmap.core.profiling import StageTimer, peak_memory_bytes
from stillmap.pipeline.result import map_recording

OURS: dict[str, dict[str, Any]] = {
    "stillmap": {},
    # (6) and (8) as printed, with voxels in place of cells: at 0.15 m the sums of every voxel that
    # beams cross take more memory than there is
    "paper, 0.3 m": {"estimator": "paper", "slam": {"voxel_size": 0.3}},
}
ESTIMATED = "stillmap, poses estimated"
# what the other Python runs, with the arguments of space_peer_worker.py
PEERS: dict[str, list[str]] = {
    "DUFOMap": ["dufomap", "0.1", "0.2", "2"],  # its authors' best for such lidars
    "DUFOMap 0.2 m": ["dufomap", "0.2", "0.2", "2"],
    "OctoMap": ["octomap", "0.2"],
}
CERTAIN = frozenset(PEERS)  # say 0 or 1
_WORKER = Path(__file__).with_name("space_peer_worker.py")


def of_ours(work: Path, method: str, settings: tuple[str, ...], threads: int, out: Path) -> Scores:
    """What stillmap takes from the recording on the disk to the whole result, nothing written."""
    # sweeps without times stay as they are: others cannot take the motion out either
    changes = config.merge_nested(
        {"read": {"spin": "none"}},
        OURS.get(method, {}),
        *(config.parse_assignment(text) for text in settings),
    )
    chosen = config.override(stillmap.Options(), {"threads": threads, **changes})
    poses = None if method == ESTIMATED else np.load(work / "poses.npy")
    recording = stillmap.read(json.loads((work / "case.json").read_text())["source"], chosen.read)
    stages, wall, cpu = StageTimer(), time.perf_counter(), time.process_time()
    result = map_recording(recording, chosen, poses=poses, stages=stages)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    peak = peak_memory_bytes()  # before the labels are picked out for whoever scores them
    np.save(out, result.p_static[np.load(work / "beam.npy")])
    T, took = recording.n_scans, stages.to_dict()
    labels = sum(took[name]["seconds"] for name in ("m_step", "e_step") if name in took)
    return {
        "seconds": wall / T,
        "label_seconds": labels / T,
        "cpu": cpu / T,
        "peak": peak / 1e6,
        "label_peak": took["e_step"]["peak_memory_bytes"] / 1e6,
        "iterations": len(result.iterations),
    }


def of_peer(work: Path, method: str, python: str, threads: int, out: Path) -> Scores:
    """What another program takes for its labels of the same beams.

    Raises:
        RuntimeError: it failed.
    """
    command = [python, str(_WORKER), str(work), str(out), str(threads), *PEERS[method]]
    env = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": str(threads)}
    with tempfile.TemporaryFile("w+") as said:
        process = subprocess.Popen(command, env=env, stdout=said, stderr=said)
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        said.seek(0)
        if process.returncode:
            raise RuntimeError(f"{method}: {said.read().strip()[-500:]}")
    took = json.loads(out.with_suffix(".json").read_text())
    T = len(np.load(work / "offset.npy")) - 1
    return {
        "seconds": took["seconds"] / T,
        "label_seconds": took["seconds"] / T,
        "cpu": took["cpu"] / T,
        "peak": used.ru_maxrss * 1024 / 1e6,
        "label_peak": used.ru_maxrss * 1024 / 1e6,
    }
