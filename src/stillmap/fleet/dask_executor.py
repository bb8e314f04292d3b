"""The same tasks on the workers of a Dask cluster; needs the extra `fleet`."""

import logging
import queue
from typing import Any

from stillmap.core.errors import InputError, import_extra
from stillmap.fleet.local_executor import EndedTask
from stillmap.fleet.outcomes import Outcome
from stillmap.fleet.tasks import Task, identify, run_task

_log = logging.getLogger(__name__)

_TIMEOUT = 15  # s for the scheduler to answer
_PERIOD = 10.0  # s between two looks at whether there are workers
# what they report ends up in an outcome here
_LOGGERS = ("distributed", "distributed.client", "tornado", "asyncio")


class DaskExecutor:
    """Workers of a scheduler.

    An equal task of the same fleet has the same key there: one that an interrupted caller left
    running is taken over, not run twice. When a worker dies, the scheduler
    runs its task elsewhere, as often as `distributed.scheduler.allowed-failures` says (3).

    Args:
        address: of the scheduler, as `tcp://HOST:8786`.

    Raises:
        InputError: none answers there, or it has no worker.
        MissingExtra: dask.distributed is not installed.
    """

    def __init__(self, address: str) -> None:
        self._dask = import_extra("distributed", address, "used", group="fleet")
        for name in _LOGGERS:
            logging.getLogger(name).setLevel(logging.CRITICAL)
        self._address = address
        try:
            self._client = self._dask.Client(address, timeout=_TIMEOUT, set_as_default=False)
        except (OSError, TimeoutError, ValueError, TypeError) as error:
            what = f"no Dask scheduler answers: {error}"
            raise InputError(what, where=address, hint="as in tcp://HOST:8786") from error
        if not self.workers():
            self._client.close()
            hint = f"start some: dask worker {address}"
            raise InputError("this scheduler has no worker", where=address, hint=hint)
        self._ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._tasks: dict[str, tuple[Any, Task, int]] = {}

    def workers(self) -> list[str]:
        """The addresses of the workers that are there now."""
        return [str(address) for address in self._client.nthreads()]

    def submit(self, task: Task, attempt: int = 1, avoid: str = "") -> None:
        others = [address for address in self.workers() if address != avoid] if avoid else []
        key = identify(task) if attempt == 1 else f"{identify(task)}-{attempt}"
        elsewhere = {"workers": others, "allow_other_workers": True} if others else {}
        future = self._client.submit(run_on_worker, task, key=key, **elsewhere)
        self._tasks[future.key] = future, task, attempt
        future.add_done_callback(self._ended.put)

    def wait(self) -> EndedTask:
        future = self._next_future()
        _, task, attempt = self._tasks.pop(future.key)
        try:
            return EndedTask(task, future.result(), attempt)
        except self._dask.KilledWorker as error:
            return EndedTask(task, Outcome("failed", f"its workers died: {error}"), attempt)
        except (ImportError, RuntimeError) as error:
            if not isinstance(error, ImportError) and "deserialization" not in str(error):
                raise
            what = "the scheduler or a worker does not know stillmap"
            hint = "install this version, and what else the client has, on all of them"
            raise InputError(what, where=self._address, hint=hint) from error
        except (self._dask.CancelledError, OSError) as error:
            raise self._is_gone() from error

    def _next_future(self) -> Any:
        """The next future that is done; warns when no worker is left."""
        warned = False
        while True:
            try:
                return self._ended.get(timeout=_PERIOD)
            except queue.Empty:
                pass
            if self._client.status != "running":
                raise self._is_gone()
            if not self.workers() and not warned:
                _log.warning("warning: %s has no worker left: waiting for one", self._address)
                warned = True

    def _is_gone(self) -> InputError:
        hint = "start it, then continue with the same command"
        return InputError("the Dask scheduler is gone", where=self._address, hint=hint)

    def limit(self, jobs: int) -> None:
        pass  # the workers decide

    def close(self) -> None:
        for future, _, _ in self._tasks.values():
            future.release()
        self._client.close()


def run_on_worker(task: Task) -> Outcome:
    """Run a task on a worker, and say on which."""
    from dataclasses import replace

    distributed = import_extra("distributed", "a worker", "used", group="fleet")
    return replace(run_task(task), worker=str(distributed.get_worker().address))
