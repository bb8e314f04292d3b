"""How many threads to use. Results do not depend on it."""

import os


def resolved_threads(asked: int) -> int:
    """`asked`, or the number of processors this process may use when that is 0."""
    if asked > 0:
        return asked
    if hasattr(os, "sched_getaffinity"):
        return max(1, len(os.sched_getaffinity(0)))
    return max(1, os.cpu_count() or 1)
