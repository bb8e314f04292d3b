"""A process of our own beside this one, with pipes to it and from it."""

import os
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Iterable
from contextlib import suppress

from stillmap.live.messages import Arrays, write_message

_SECONDS_TO_END = 5.0  # before the process is killed


class ChildProcess:
    """Runs a module, which calls `serve`, in a process of its own.

    Args:
        module: its name.
        arguments: of the command line.

    Attributes:
        stdin, stdout, id: of the process.
    """

    def __init__(self, module: str, *arguments: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", module, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            process_group=0,  # Ctrl-C is for this process alone
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self.stdin, self.stdout = self._process.stdin, self._process.stdout
        self.id = self._process.pid
        self._threads: list[threading.Thread] = []

    @property
    def has_ended(self) -> bool:
        return self._process.poll() is not None

    def start(self, *work: Callable[[], None]) -> None:
        """Start threads: one that sends, and one that reads until the process ends."""
        self._threads = [threading.Thread(target=one, daemon=True) for one in work]
        for thread in self._threads:
            thread.start()

    def send(self, messages: Iterable[Arrays]) -> None:
        """Write messages until there are no more, or the process has ended."""
        with suppress(BrokenPipeError):
            for message in messages:
                write_message(self.stdin, message)
        self._close_stdin()

    def stop(self) -> None:
        """Wait for the end of the process, which `send` has no more for; kill it after a while."""
        if not self._threads:
            self._close_stdin()
        try:
            self._process.wait(_SECONDS_TO_END)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        for thread in self._threads:
            thread.join()
        self._close_stdin()
        self.stdout.close()

    def _close_stdin(self) -> None:
        with suppress(BrokenPipeError):
            self.stdin.close()


def serve(work: Callable[[], None]) -> None:
    """Work for the process that started this one, until that ends."""
    try:
        work()
    except BrokenPipeError:
        os._exit(0)  # the other process has ended
    except Exception:
        traceback.print_exc()
        os._exit(1)  # at once: a thread still reads
