"""How many threads to use, and work that they share. Results do not depend on it."""

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
    """`asked`, or the number of processors this process may use when that is 0."""
    if requested > 0:
        return requested
    if hasattr(os, "sched_getaffinity"):
        return max(1, len(os.sched_getaffinity(0)))
    return max(1, os.cpu_count() or 1)


@contextmanager
def limit_blas_threads() -> Iterator[None]:
    """Linear algebra by one thread meanwhile, in the whole process.

    Matrices are small here, and kernels have threads of their own. BLAS's wait for each other
    busily: where other processes want the processors, that costs more than all the work. Sums no
    longer depend on how many processors there are, either.
    """
    import scipy.linalg  # noqa: F401  (SciPy has a BLAS of its own; takes long to load)

    with threadpool_limits(limits=1, user_api="blas"):
        yield


def map_ordered(
    work: Callable[[_Item], _Outcome], items: Iterable[_Item], threads: int
) -> Iterator[_Outcome]:
    """`map` by several threads: what comes of the items, in their order.

    Each thread is one item ahead at most, so that little waits in memory. It pays where `work` is
    long and most of it lets other threads run, as NumPy does on large arrays and kernels do.
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
