"""Loops closed in a process of their own, so that no pose waits for them.

Not in a thread: GTSAM holds Python's lock while it solves a pose graph.
"""

import itertools
import logging
import queue
import subprocess
import sys
import threading
from collections import deque
from contextlib import suppress
from dataclasses import replace
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from stillmap.core.array_types import Float
from stillmap.core.parallel import trim_heap
from stillmap.live.local_map import MappedScan
from stillmap.live.loop_closer import Correction, LoopCloser
from stillmap.live.sweep_loop_closer import LiveSweepLoopCloser
from stillmap.slam.options import SlamOptions

_log = logging.getLogger(__name__)

_TRIM_EVERY = 64  # scans after which the child gives freed memory back
_SECONDS_TO_END = 5.0  # before the process is killed


class LoopProcess:
    """A `LoopCloser` in a child process: scans go there, corrections come back.

    Args:
        options: see SlamOptions.
        dimension: 2 or 3.
        folder: of temporary files; None: the system's.
    """

    def __init__(self, options: SlamOptions, dimension: int, folder: Path | None = None) -> None:
        self._pipe, end = Pipe()
        with end:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "stillmap.live.loop_process", str(end.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=[end.fileno()],
                process_group=0,  # Ctrl-C is for this process alone
            )
        self._outgoing = queue.SimpleQueue[Any]()
        self._outgoing.put((options, dimension, folder))
        self._incoming = deque[Correction]()
        self._has_ended = False
        work = (self._send, self._receive)
        self._threads = [threading.Thread(target=run, daemon=True) for run in work]
        for thread in self._threads:
            thread.start()

    def add(self, scan: MappedScan, explained: float, drift: Float) -> None:
        """Add a spaced scan, as of `LoopCloser.add`. Never waits."""
        if not self._has_ended:  # nobody takes it out of the queue then
            self._outgoing.put((scan, explained, drift))

    def poll(self) -> Correction | None:
        """The last correction that has arrived; None: there is no new one."""
        last = None
        while self._incoming:
            last = self._incoming.popleft()
        if not self._has_ended and self._process.poll() is not None:
            self._has_ended = True
            _log.warning("the process that closes loops has ended: loops are no longer closed")
        return last

    def stop(self) -> None:
        """End the process; kill it where that takes long."""
        self._has_ended = True
        self._outgoing.put(None)
        try:
            self._process.wait(_SECONDS_TO_END)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        for thread in self._threads:
            thread.join()
        self._pipe.close()

    def _send(self) -> None:
        with suppress(OSError):  # the process has ended
            for message in iter(self._outgoing.get, None):
                self._pipe.send(message)
            self._pipe.send(None)

    def _receive(self) -> None:
        with suppress(EOFError, OSError):  # the process has ended, perhaps amid a correction
            while True:
                correction, count = self._pipe.recv()
                near = [self._pipe.recv() for _ in range(count)]
                self._incoming.append(replace(correction, near=near))


def make_closer(
    options: SlamOptions, dimension: int, folder: Path | None, threads: int
) -> LoopCloser | LiveSweepLoopCloser:
    """A loop closer for 2D or 3D, in this process."""
    if dimension == 2:
        return LoopCloser(options, folder)
    return LiveSweepLoopCloser(options, folder, threads)


def _close_loops(pipe: "Connection[Any, Any]") -> None:
    """Close loops between the scans that arrive, until there are no more."""
    options, dimension, folder = pipe.recv()
    # one thread: the other cores answer scans
    closer = make_closer(options, dimension, folder, threads=1)
    for number in itertools.count(1):
        message = pipe.recv()
        if message is None:
            return
        if number % _TRIM_EVERY == 0:
            trim_heap()
        closer.add(*message)
        if not pipe.poll() and (correction := closer.poll()) is not None:
            pipe.send((replace(correction, near=[]), len(correction.near)))
            for scan in correction.near:  # all at once would be unpacked with Python's lock held
                pipe.send(scan)
            del correction
            trim_heap()


if __name__ == "__main__":
    with suppress(EOFError, OSError):  # the other process has ended, or says that the disk is full
        _close_loops(Connection(int(sys.argv[1])))
