"""Thread counts and ordered parallel map; results do not depend on the number of threads."""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

_Item = TypeVar("_Item")
_Outcome = TypeVar("_Outcome")


def resolve_threads(requested: int) -> int:
    """`requested`, or for 0 the number of processors available to this process."""
    if requested > 0:
        return requested
    if hasattr(os, "sched_getaffinity"):
        return max(1, len(os.sched_getaffinity(0)))
    return max(1, os.cpu_count() or 1)


@contextmanager
def limit_blas_threads() -> Iterator[None]:
    """Limit BLAS to one thread in the whole process.

    Matrices are small, kernels have threads of their own, and the busy waiting of BLAS threads
    costs more than the work on a loaded machine. It also makes sums independent of the processors.
    """
    import scipy.linalg  # noqa: F401  (SciPy has a BLAS of its own; slow to load)

    with threadpool_limits(limits=1, user_api="blas"):
        yield


def map_ordered(
    work: Callable[[_Item], _Outcome], items: Iterable[_Item], threads: int
) -> Iterator[_Outcome]:
    """`map` over several threads, results in order of the items.

    Each thread is at most one item ahead, so that few results wait in memory. Worth it where `work`
    is long and releases the GIL, as NumPy does on large arrays and kernels do.
    """
    if threads <= 1:
        yield from map(work, items)
        return
    with ThreadPoolExecutor(threads) as pool:
        ahead: deque[Future[_Outcome]] = deque()
        for item in items:
            ahead.append(pool.submit(work, item))
            if len(ahead) > threads:
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()
