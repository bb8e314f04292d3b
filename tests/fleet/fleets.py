"""What the tests of fleets share: what a fleet leaves, waiting."""

import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

NAMES = ("hall", "office", "yard")  # of the recordings


def files_of(folder: Path) -> set[str]:
    """Relative paths of all files and empty folders below a folder."""
    found = (p for p in folder.rglob("*") if p.is_file() or not any(p.iterdir()))
    return {str(p.relative_to(folder)) for p in found}


def unfinished(folder: Path) -> set[str]:
    """What a finished fleet should not have."""
    kept = ("results/", "places/", ".fleet/labels/")
    own = {"fleet.json", "fleet.html", ".fleet/lock", ".fleet/journal.jsonl"}
    return {one for one in files_of(folder) if not one.startswith(kept)} - own


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
    found = {pid}
    while new := {one for one, parent in parents.items() if parent in found} - found:
        found |= new
    return found - {pid}


def is_alive(pid: int) -> bool:
    """Whether a process runs; not one that has ended and that nobody has waited for."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
