"""Memory that a recording needs to be mapped, told from its summary, and that of the machine."""

import math
import os
from collections.abc import Iterable, Mapping
from typing import Any

# an upper figure: of 13 recordings of 60 to 100 000 scans none needed more (docs/fleet.md)
_BASE = {2: 200 << 20, 3: 300 << 20}  # bytes: interpreter, libraries, arrays that do not grow
_PER_SCAN = 30_000  # bytes: poses, covariances, the map that a scan adds
_PER_BEAM = 60  # bytes: arrays, and pages of files that are mapped
_PER_CELL = 70  # bytes of a cell of the plane within range
_KEPT_FREE = 0.1  # share of the memory for everything else


def estimate_memory(info: Mapping[str, Any], resolution: float) -> int:
    """Bytes that mapping a recording takes at most, roughly.

    Args:
        info: its summary, see `stillmap info --json`.
        resolution: edge of a cell in metres.
    """
    ranges = info.get("hit_ranges_m")
    reach = float(ranges["p99"]) if ranges and info.get("dimension") == 2 else 0.0
    cells = math.pi * (reach / resolution) ** 2
    by_size = _PER_SCAN * int(info["scans"]) + _PER_BEAM * int(info["beams"])
    return round(_BASE[int(info["dimension"])] + by_size + _PER_CELL * cells)


def machine_memory() -> int:
    """Bytes that processes of this machine, or container, may use together."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return round(total * (1 - _KEPT_FREE))


def fitting_jobs(estimates: Iterable[int], jobs: int, memory: int) -> int:
    """How many of the tasks, at most `jobs`, may run at once so that any of them fit into `memory`.

    One may always run.
    """
    largest = sorted(estimates, reverse=True)[:jobs]
    while len(largest) > 1 and sum(largest) > memory:
        largest.pop()
    return len(largest)
