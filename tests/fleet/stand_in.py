"""Stands in for stillmap's commands: a recording is a file with a word that says what its `map`
does: "fine", "bad", "defect", "full".
"""

import errno
import json
import os
import signal
from pathlib import Path

import numpy as np

from stillmap.core.array_folder import FORMAT_VERSION
from stillmap.core.errors import InputError


def run_command(words):
    output = Path(words[words.index("-o") + 1])
    flags = words[words.index("--quiet") + 1 :]
    if words[0] == "merge":
        inputs = [Path(word) for word in words[1 : words.index("-o")]]
        if "refuse" in str(output):
            raise InputError("fewer than two sessions fit")
        if output.name == "full":
            raise OSError(errno.ENOSPC, "No space left on device", str(output))
        # as merging does, which reads the recordings again
        recordings = [json.loads((path / "run.json").read_text())["input"] for path in inputs]
        texts = [Path(recording["path"]).read_text() for recording in recordings]
        more = {"merged": [path.name for path in inputs], "texts": texts}
        write(output, {"input": {"path": str(inputs[0])}, "flags": flags, **more})
        sessions = [{"name": path.name, "input": str(path), "accepted": True} for path in inputs]
        (output / "sessions.json").write_text(json.dumps(sessions))
        return
    recording = Path(words[1])
    what = recording.read_text().strip()
    if what == "bad":
        raise InputError("no two scans", where=str(recording))
    if what == "full":
        raise OSError(errno.ENOSPC, "No space left on device", str(output))
    if what == "defect":
        raise ValueError(7)
    write(output, {"input": {"path": str(recording)}, "flags": flags})


def write(output, more):
    (output / "beams").mkdir(parents=True)
    counts = {"scans": 10, "beams": 1000}
    record = {
        "format_version": FORMAT_VERSION,
        "counts": counts,
        "warnings": [],
        "quality": {"overall": 80.0},
        **more,
    }
    (output / "run.json").write_text(json.dumps(record))
    np.save(output / "beams/stamp_ns.npy", np.array([10, 46], np.int64) * 10**9)
    # a map without cells
    cells = np.zeros((0, 0), np.float32)
    np.savez(output / "map.npz", p_occupied=cells, origin=np.zeros(3), resolution=0.05)


def die(words):
    """A command that ends its process where a recording is called `deadly`."""
    if "deadly" in words[1]:
        os.kill(os.getpid(), signal.SIGKILL)
    raise InputError("it lives")
