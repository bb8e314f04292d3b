"""Loops closed in a process of their own, so that no pose waits for them.

Not in a thread: GTSAM holds Python's lock while it solves a pose graph.
"""

import itertools
import logging
import os
import pickle
import queue
import subprocess
import sys
import threading
import traceback
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

from stillmap.core.array_types import Float
from stillmap.core.parallel import trim_heap
from stillmap.live.local_map import MappedScan
from stillmap.live.loop_closer import Correction, LoopCloser
from stillmap.live.sweep_loop_closer import LiveSweepLoopCloser
from stillmap.slam.options import SlamOptions

_log = logging.getLogger(__name__)

_TRIM_EVERY = 64  # scans after which the child gives freed memory back
_SECONDS_TO_END = 5.0  # before the process is killed


def send(stream: IO[bytes], *messages: Any) -> None:
    """Write messages and flush."""
    for message in messages:
        pickle.dump(message, stream, pickle.HIGHEST_PROTOCOL)
    stream.flush()


def receive(stream: IO[bytes]) -> Iterator[Any]:
    """The messages until the stream ends, perhaps amid one."""
    with suppress(EOFError, pickle.UnpicklingError):
        while True:
            yield pickle.load(stream)


class LoopProcess:
    """A `LoopCloser` in a child process: scans go there, corrections come back.

    Args:
        options: see SlamOptions.
        dimension: 2 or 3.
        folder: of temporary files; None: the system's.
    """

    def __init__(self, options: SlamOptions, dimension: int, folder: Path | None = None) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "stillmap.live.loop_process"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
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

    def _send(self) -> None:
        assert self._process.stdin is not None
        with suppress(BrokenPipeError), self._process.stdin as stdin:
            for message in iter(self._outgoing.get, None):
                send(stdin, message)

    def _receive(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as stdout:
            messages = receive(stdout)
            for correction, count in messages:
                near = list(itertools.islice(messages, count))
                if len(near) == count:  # else the process has ended amid them
                    self._incoming.append(replace(correction, near=near))


def make_closer(
    options: SlamOptions, dimension: int, folder: Path | None, threads: int
) -> LoopCloser | LiveSweepLoopCloser:
    """A loop closer for 2D or 3D, in this process."""
    if dimension == 2:
        return LoopCloser(options, folder)
    return LiveSweepLoopCloser(options, folder, threads)


def _close_loops(source: IO[bytes], target: IO[bytes]) -> None:
    """Close loops between the scans that arrive, until there are no more."""
    messages = receive(source)
    options, dimension, folder = next(messages)
    # one thread: the other cores answer scans
    closer = make_closer(options, dimension, folder, threads=1)
    arrived = queue.SimpleQueue[Any]()

    def listen() -> None:
        for message in messages:
            arrived.put(message)
        arrived.put(None)

    threading.Thread(target=listen, daemon=True).start()
    for number, message in enumerate(iter(arrived.get, None), start=1):
        if number % _TRIM_EVERY == 0:
            trim_heap()
        closer.add(*message)
        if arrived.empty() and (correction := closer.poll()) is not None:
            # scan by scan: all at once would be unpacked with Python's lock held
            send(target, (replace(correction, near=[]), len(correction.near)), *correction.near)
            del correction
            trim_heap()


if __name__ == "__main__":
    try:
        _close_loops(sys.stdin.buffer, sys.stdout.buffer)
    except OSError:
        os._exit(0)  # the other process has ended, or the disk is full: it says so
    except Exception:
        traceback.print_exc()
        os._exit(1)  # at once: a thread still reads
