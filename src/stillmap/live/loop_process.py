"""Loops closed in a process of their own, so that no pose waits for them.

Not in a thread: GTSAM holds Python's lock while it solves a pose graph.
"""

import itertools
import json
import logging
import os
import queue
import struct
import subprocess
import sys
import threading
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import config
from stillmap.core.parallel import trim_heap
from stillmap.live.local_map import MappedScan
from stillmap.live.loop_closer import Correction, LoopCloser
from stillmap.live.scan import ScanBeams
from stillmap.live.sweep_loop_closer import LiveSweepLoopCloser
from stillmap.slam.options import SlamOptions

Float = NDArray[np.float64]
Arrays = Mapping[str, NDArray[Any]]

_log = logging.getLogger(__name__)

_NUMBERS = list[str | int](range(256))  # of sensors, which stand for their names in the child
_TRIM_EVERY = 64  # scans after which the child gives freed memory back
_SECONDS_TO_END = 5.0  # before the process is killed
_LENGTH = struct.Struct("<Q")
_MAX_HEADER = 1 << 26  # bytes: a correction in a large hall has thousands of scans


def write_message(stream: IO[bytes], arrays: Arrays) -> None:
    """Write named arrays of numbers and flush."""
    plain = {name: np.asarray(array, order="C") for name, array in arrays.items()}
    fields = [[name, a.dtype.str, list(a.shape)] for name, a in plain.items()]
    header = json.dumps(fields).encode()
    stream.write(_LENGTH.pack(len(header)) + header)
    for array in plain.values():
        stream.write(array.reshape(-1).view(np.uint8).data)
    stream.flush()


def read_message(stream: IO[bytes]) -> dict[str, NDArray[Any]] | None:
    """Read named arrays; None: the stream has ended, perhaps amid a message.

    Raises:
        ValueError: these are no arrays.
    """
    start = stream.read(_LENGTH.size)
    if len(start) < _LENGTH.size:
        return None
    (length,) = _LENGTH.unpack(start)
    if length > _MAX_HEADER:
        raise ValueError(f"header: expected at most {_MAX_HEADER} bytes, got {length}")
    header = stream.read(length)
    if len(header) < length:
        return None
    out = {}
    for name, dtype, shape in json.loads(header):
        kind = np.dtype(dtype)
        if kind.hasobject:
            raise ValueError(f"{name}: expected numbers")
        size = int(np.prod(shape, dtype=np.int64)) * kind.itemsize
        data = stream.read(size)
        if len(data) < size:
            return None
        out[name] = np.frombuffer(data, kind).reshape(shape)
    return out


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
        self._threads = [threading.Thread(target=run, daemon=True) for run in work]
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


class LoopProcess:
    """A `LoopCloser` in a child process: scans go there, corrections come back.

    Args:
        options: see SlamOptions.
        dimension: 2 or 3.
        folder: of temporary files; None: the system's.
    """

    def __init__(self, options: SlamOptions, dimension: int, folder: Path | None = None) -> None:
        settings = {
            "slam": asdict(options),
            "dimension": dimension,
            "folder": None if folder is None else str(folder),
        }
        self._process = ChildProcess("stillmap.live.loop_process", json.dumps(settings))
        self._outgoing: queue.SimpleQueue[dict[str, NDArray[Any]] | None] = queue.SimpleQueue()
        self._incoming = deque[Correction]()
        self._sensors: list[str | int] = []
        self._has_ended = False
        self._process.start(self._send, self._receive)

    def add(self, scan: MappedScan, explained: float, drift: Float) -> None:
        """Add a spaced scan, as of `LoopCloser.add`. Never waits."""
        if self._has_ended:
            return  # nobody takes it out of the queue
        if scan.beams.sensor not in self._sensors:
            self._sensors.append(scan.beams.sensor)
        message = _pack_scans([scan], self._sensors)
        self._outgoing.put({**message, "explained": np.array(explained), "drift": drift})

    def poll(self) -> Correction | None:
        """The last correction that has arrived; None: there is no new one."""
        found = None
        while self._incoming:
            found = self._incoming.popleft()
        if not self._has_ended and self._process.has_ended:
            self._has_ended = True
            _log.warning("the process that closes loops has ended: loops are no longer closed")
        return found

    def stop(self) -> None:
        """End the process."""
        self._has_ended = True
        self._outgoing.put(None)
        self._process.stop()

    def _send(self) -> None:
        self._process.send(iter(self._outgoing.get, None))

    def _receive(self) -> None:
        while (message := read_message(self._process.stdout)) is not None:
            near = _unpack_scans(message, self._sensors)
            untied = tuple(message["untied"].tolist())
            self._incoming.append(
                Correction(message["T_map_local"], message["poses"], near, untied)
            )


def _pack_scans(scans: list[MappedScan], sensors: list[str | int]) -> dict[str, NDArray[Any]]:
    """Scans as one array for each field: many small ones would take long to unpack, with Python's
    lock held."""
    every = [scan.beams for scan in scans]
    if not scans:
        return {"count": np.zeros(0, np.int64)}
    return {
        "count": np.array([len(beams.points) for beams in every]),
        "stamp_ns": np.array([beams.stamp_ns for beams in every]),
        "points": np.concatenate([beams.points for beams in every]),
        "hit": np.concatenate([beams.hit for beams in every]),
        "T_base_sensor": np.array([beams.T_base_sensor for beams in every]),
        "sensor": np.array([sensors.index(beams.sensor) for beams in every]),
        "e": np.concatenate([scan.e for scan in scans]),
        "T_map_base": np.array([scan.T_map_base for scan in scans]),
        "travelled": np.array([scan.travelled for scan in scans]),
    }


def _unpack_scans(message: dict[str, NDArray[Any]], sensors: list[str | int]) -> list[MappedScan]:
    end = np.cumsum(message["count"]).tolist()
    scans = []
    for k, (first, stop) in enumerate(zip([0, *end], end, strict=False)):
        beams = ScanBeams(
            int(message["stamp_ns"][k]),
            message["points"][first:stop],
            message["hit"][first:stop],
            message["T_base_sensor"][k],
            sensors[int(message["sensor"][k])],
        )
        e, T = message["e"][first:stop], message["T_map_base"][k]
        scans.append(MappedScan(beams, e, T, float(message["travelled"][k])))
    return scans


def start_closer(
    options: SlamOptions, dimension: int, background: bool, folder: Path | None, threads: int
) -> LoopCloser | LiveSweepLoopCloser | LoopProcess:
    """A loop closer for 2D or 3D, in a process of its own or in this one."""
    if background:
        return LoopProcess(options, dimension, folder)
    return _make_closer(options, dimension, folder, threads)


def _make_closer(
    options: SlamOptions, dimension: int, folder: Path | None, threads: int
) -> LoopCloser | LiveSweepLoopCloser:
    if dimension == 2:
        return LoopCloser(options, folder)
    return LiveSweepLoopCloser(options, folder, threads)


def _close_loops(settings: dict[str, Any], source: IO[bytes], target: IO[bytes]) -> None:
    """Close loops between the scans that arrive, until there are no more."""
    folder = None if settings["folder"] is None else Path(settings["folder"])
    options = config.override(SlamOptions(), settings["slam"])
    # one thread: the other cores answer scans
    closer = _make_closer(options, settings["dimension"], folder, threads=1)
    arrived: queue.SimpleQueue[dict[str, NDArray[Any]] | None] = queue.SimpleQueue()

    def listen() -> None:
        while (message := read_message(source)) is not None:
            arrived.put(message)
        arrived.put(None)

    threading.Thread(target=listen, daemon=True).start()
    for number in itertools.count(1):
        if (message := arrived.get()) is None:
            return
        if number % _TRIM_EVERY == 0:
            trim_heap()
        (scan,) = _unpack_scans(message, _NUMBERS)
        closer.add(scan, float(message["explained"]), message["drift"])
        if arrived.empty() and (found := closer.poll()) is not None:
            poses = {"T_map_local": found.T_map_local, "poses": found.poses}
            untied = {"untied": np.array(found.untied, np.int64)}
            write_message(target, {**_pack_scans(found.near, _NUMBERS), **poses, **untied})
            del found, message
            trim_heap()


def serve(work: Callable[[], None]) -> None:
    """Work for the process that started this one, until that ends."""
    try:
        work()
    except OSError:
        os._exit(0)  # the other process has ended, or the disk is full: it says so
    except Exception:
        traceback.print_exc()
        os._exit(1)  # at once: a thread still reads


if __name__ == "__main__":
    settings = json.loads(sys.argv[1])
    serve(lambda: _close_loops(settings, sys.stdin.buffer, sys.stdout.buffer))
