"""Tasks in processes of this machine."""

import queue
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, Protocol

from stillmap.fleet.child import Stopped
from stillmap.fleet.outcomes import Outcome
from stillmap.fleet.tasks import Task, run_task


class EndedTask(NamedTuple):
    """A task, how it ended, and which attempt that was, from 1."""

    task: Task
    outcome: Outcome
    attempt: int


class Executor(Protocol):
    """Runs tasks, several at once."""

    def submit(self, task: Task, attempt: int = 1, avoid: str = "") -> None:
        """Run a task as soon as possible; rather not on the worker `avoid`."""

    def wait(self) -> EndedTask:
        """The next task that ends, in any order."""

    def limit(self, jobs: int) -> None:
        """Run at most so many tasks of this machine at once from now on; none runs now."""

    def close(self) -> None:
        """Let no further task begin; end those that run where that is possible."""


class LocalExecutor:
    """Child processes of this process, one per thread.

    Args:
        jobs: how many tasks run at once.
    """

    def __init__(self, jobs: int) -> None:
        self._pool = ThreadPoolExecutor(jobs)
        self._ended: queue.SimpleQueue[EndedTask | BaseException] = queue.SimpleQueue()
        self._stop = threading.Event()

    def submit(self, task: Task, attempt: int = 1, avoid: str = "") -> None:  # noqa: ARG002
        self._pool.submit(self._run, task, attempt)

    def _run(self, task: Task, attempt: int) -> None:
        try:
            if not self._stop.is_set():
                self._ended.put(EndedTask(task, run_task(task, self._stop), attempt))
        except Stopped:
            pass
        except BaseException as error:
            self._ended.put(error)  # a defect: raised where the tasks are waited for

    def wait(self) -> EndedTask:
        ended = self._ended.get()
        if isinstance(ended, BaseException):
            raise ended
        return ended

    def limit(self, jobs: int) -> None:
        self._pool.shutdown()
        self._pool = ThreadPoolExecutor(jobs)

    def close(self) -> None:
        self._stop.set()
        self._pool.shutdown(cancel_futures=True)
