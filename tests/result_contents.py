"""The files of a result, to compare results of runs that ended at other times."""

import json
import re
from pathlib import Path

from flat import files_of

# that every result in the plane has
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


def contents(folder: Path) -> dict[str, bytes]:
    """All files of a result, without what tells of time and memory in them."""
    out = files_of(folder)
    run = json.loads(out["run.json"])
    for name in ("seconds", "cpu_seconds", "peak_memory_bytes"):
        del run[name]
    for iteration in run["iterations"]:
        del iteration["seconds"]
    report = re.sub(rb"<h3>Time and memory</h3>.*?</details>", b"", out["report.html"], flags=re.S)
    report = re.sub(rb"<div><dt>Computed in</dt>.*?</div>", b"", report)
    report = re.sub(rb"<td[^<>]*>[0-9.,]+ (ms|s|min)</td>", b"", report)
    return {**out, "run.json": json.dumps(run).encode(), "report.html": report}
