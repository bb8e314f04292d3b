"""Thread counts and ordered parallel map; results do not depend on the number of threads."""

import ctypes
import os
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

from threadpoolctl import ThreadpoolController  # type: ignore[import-untyped]

_Item = TypeVar("_Item")
_Outcome = TypeVar("_Outcome")

# read by a BLAS when it is loaded
_BLAS_VARIABLES = (
    *("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"),
    *("BLIS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"),
)


def resolve_threads(requested: int) -> int:
    """`requested`, or for 0 the number of processors available to this process."""
    if requested > 0:
        return requested
    if hasattr(os, "sched_getaffinity"):
        return max(1, len(os.sched_getaffinity(0)))
    return max(1, os.cpu_count() or 1)


_BEAMS_PER_THREAD = 1 << 15  # traced in some ten milliseconds


def counting_threads(n_beams: int, threads: int) -> int:
    """The number of threads that are worth a grid each, for counting beams in cells.

    Every thread fills a grid of its own, which covers most of the place, before they are summed.
    """
    return max(1, min(threads, n_beams // _BEAMS_PER_THREAD))


@contextmanager
def limit_blas_threads() -> Iterator[None]:
    """Limit BLAS to one thread in the whole process.

    Matrices are small, kernels have threads of their own, and the busy waiting of BLAS threads
    costs more than the work on a loaded machine. It also makes sums independent of the processors.
    SciPy, whose BLAS is another one than NumPy's, may be loaded within: its BLAS then begins with
    one thread, and gets as many as there are processors afterwards.
    """
    had_scipy = "scipy.linalg" in sys.modules
    limited = ThreadpoolController()
    with limited.limit(limits=1, user_api="blas"), _set_variables(_BLAS_VARIABLES, "1"):
        yield
    if not had_scipy and "scipy.linalg" in sys.modules:
        known = {library.filepath for library in limited.lib_controllers}
        for library in ThreadpoolController().select(user_api="blas").lib_controllers:
            if library.filepath not in known:
                library.set_num_threads(resolve_threads(0))


@contextmanager
def _set_variables(names: Iterable[str], value: str) -> Iterator[None]:
    """Set environment variables within the block."""
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(before, value))
    try:
        yield
    finally:
        for name, old in before.items():
            if old is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = old


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


@contextmanager
def work_beside(work: Callable[[], _Outcome], threads: int) -> Iterator[Callable[[], _Outcome]]:
    """Do `work` in another thread during the block, which is given a function that waits for it.

    With one thread, `work` is done when its outcome is asked for.
    """
    if threads <= 1:
        yield work
        return
    with ThreadPoolExecutor(1) as pool:
        yield pool.submit(work).result


def trim_heap() -> None:
    """Give freed memory back to the system, after a stage that needed much of it.

    The blocks of the kernels' grids are small: the allocator keeps them when a grid goes, one heap
    per thread, and the next stage takes others. Only glibc does so and has a function against it.
    """
    if sys.platform != "linux":
        return
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
