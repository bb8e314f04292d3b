"""Progress, time and memory of the stages of a run."""

import resource
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

# stage, iteration (0: outside the loop), scans done, of how many (0: not counted)
Progress = Callable[[str, int, int, int], None]


def no_progress(stage: str, iteration: int, done: int, total: int) -> None:
    """Discards progress."""


class StageTimer:
    """Wall-clock and CPU time per stage, summed over calls, and peak memory after the last one."""

    def __init__(self) -> None:
        self._stages: dict[str, dict[str, Any]] = {}

    @contextmanager
    def measure(self, name: str) -> Iterator[None]:
        """Add the time of the block to stage `name`."""
        started, cpu = time.perf_counter(), time.process_time()
        try:
            yield
        finally:
            stage = self._stages.setdefault(name, {"seconds": 0.0, "cpu_seconds": 0.0})
            stage["seconds"] += time.perf_counter() - started
            stage["cpu_seconds"] += time.process_time() - cpu  # of all threads
            stage["peak_memory_bytes"] = peak_memory_bytes()

    def add(self, earlier: Mapping[str, Mapping[str, Any]]) -> None:
        """Add the stages of the run that this one resumes, as `to_dict` returned them."""
        for name, one in earlier.items():
            stage = self._stages.setdefault(name, {"seconds": 0.0, "cpu_seconds": 0.0})
            stage["seconds"] += one["seconds"]
            stage["cpu_seconds"] += one["cpu_seconds"]
            known = stage.get("peak_memory_bytes", 0)
            stage["peak_memory_bytes"] = max(known, one["peak_memory_bytes"])

    def to_dict(self) -> dict[str, dict[str, Any]]:
        """`seconds`, `cpu_seconds` and `peak_memory_bytes` (of the process so far) by stage."""
        return {name: dict(stage) for name, stage in self._stages.items()}


def peak_memory_bytes() -> int:
    """Peak resident memory of this process."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
