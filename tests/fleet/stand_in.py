"""Stands in for stillmap in tests of the fleet: a recording is a file with a word that says what
its `map` does: "fine", "killed N" (by SIGKILL, N times), "bad", "defect", "full", "slow".
"""

import json
import os
import signal
import sys
import time
from pathlib import Path


def main(words: list[str]) -> int:
    if words[0] == "info":
        ranges = {"min": 1.0, "median": 2.0, "p99": 5.0, "max": 9.0}
        found = {"scans": 10, "beams": 1000, "dimension": 2, "hit_ranges_m": ranges}
        print(json.dumps({**found, "time": {"duration_s": 36.0}}))
        return 0
    output = Path(words[words.index("-o") + 1])
    if words[0] == "merge":
        return merge([Path(word) for word in words[1 : words.index("-o")]], output, words)
    return map_recording(Path(words[1]), output, words)


def map_recording(recording: Path, output: Path, words: list[str]) -> int:
    what, _, number = recording.read_text().strip().partition(" ")
    count = recording.with_suffix(".attempts")
    attempts = int(count.read_text()) + 1 if count.exists() else 1
    count.write_text(str(attempts))
    if what == "killed" and attempts <= int(number):
        os.kill(os.getpid(), signal.SIGKILL)
    if what == "bad":
        print(f"stillmap: {recording}: no two scans", file=sys.stderr)
        return 2
    if what == "full":
        print(f"stillmap: {output}: cannot continue: No space left on device", file=sys.stderr)
        return 2
    if what == "defect":
        print("Traceback\nValueError: 7", file=sys.stderr)
        return 1
    if what == "slow":
        time.sleep(30)
    write(output, {"words": words})
    return 0


def merge(results: list[Path], output: Path, words: list[str]) -> int:
    if any((result / "run.json").stat().st_size == 0 for result in results):
        return 2
    if output.parent.joinpath("refuse").exists():
        return 2
    sessions = [{"name": one.name, "input": str(one), "accepted": True} for one in results]
    write(output, {"merged": [one.name for one in results], "words": words})
    (output / "sessions.json").write_text(json.dumps(sessions))
    return 0


def write(output: Path, more: dict[str, object]) -> None:
    output.mkdir(parents=True)
    record = {"input": {"path": "x"}, "warnings": [], **more, "quality": {"overall": 80.0}}
    (output / "run.json").write_text(json.dumps(record))
    # an archive of a map without cells, as NumPy writes it
    import numpy as np

    origin = np.zeros(3)
    cells = np.zeros((0, 0), np.float32)
    np.savez(output / "map.npz", p_occupied=cells, origin=origin, resolution=0.05)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
