"""Names of the recordings of a fleet, and its processes."""

import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

NAMES = ("hall", "office", "yard")  # of the recordings


def wait_until(condition: Callable[[], object], seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited for too long"
        time.sleep(0.01)


def children_of(pid: int) -> set[int]:
    """The living processes below a process (Linux)."""
    parents = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            state, parent = path.read_text().rpartition(")")[2].split()[:2]
            if state != "Z":
                parents[int(path.parent.name)] = int(parent)
    below = {pid}
    while new := {child for child, parent in parents.items() if parent in below} - below:
        below |= new
    return below - {pid}
