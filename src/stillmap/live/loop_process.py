"""Loops closed in a process of their own, so that no pose waits for them.

Not in a thread: GTSAM holds Python's lock while it solves a pose graph.
"""

import json
import logging
import os
import queue
import subprocess
import sys
import threading
import traceback
from collections import deque
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import config
from stillmap.live.local_map import MappedScan
from stillmap.live.loop_closer import Correction, LoopCloser
from stillmap.live.messages import read_message, write_message
from stillmap.live.scan import ScanBeams
from stillmap.live.sweep_loop_closer import LiveSweepLoopCloser
from stillmap.slam.options import SlamOptions

Float = NDArray[np.float64]

_log = logging.getLogger(__name__)

_SECONDS_TO_END = 5.0  # before the process is killed


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
        self._process = subprocess.Popen(
            [sys.executable, "-m", "stillmap.live.loop_process", json.dumps(settings)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            process_group=0,  # Ctrl-C is for this process alone
        )
        self._outgoing: queue.SimpleQueue[dict[str, NDArray[Any]] | None] = queue.SimpleQueue()
        self._incoming = deque[Correction]()
        self._sensors: list[str | int] = []
        self._has_ended = False
        self._threads = [
            threading.Thread(target=work, daemon=True) for work in (self._send, self._receive)
        ]
        for thread in self._threads:
            thread.start()

    def add(self, scan: MappedScan, explained: float, drift: Float) -> None:
        """Add a spaced scan, as of `LoopCloser.add`. Never waits."""
        if self._has_ended:
            return  # nobody takes it out of the queue
        if scan.beams.sensor not in self._sensors:
            self._sensors.append(scan.beams.sensor)
        sensor = self._sensors.index(scan.beams.sensor)
        self._outgoing.put(
            {
                **_pack_scan(scan, sensor),
                "explained": np.array(explained),
                "drift": drift,
            }
        )

    def poll(self) -> Correction | None:
        """The last correction that has arrived; None: there is no new one."""
        found = None
        while self._incoming:
            found = self._incoming.popleft()
        if not self._has_ended and self._process.poll() is not None:
            self._has_ended = True
            _log.warning("the process that closes loops has ended: loops are no longer closed")
        return found

    def stop(self) -> None:
        """End the process."""
        self._has_ended = True
        self._outgoing.put(None)
        try:
            self._process.wait(_SECONDS_TO_END)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        for thread in self._threads:
            thread.join()
        for stream in (self._process.stdin, self._process.stdout):
            assert stream is not None
            with suppress(BrokenPipeError):
                stream.close()

    def _send(self) -> None:
        stream = self._process.stdin
        assert stream is not None
        while (message := self._outgoing.get()) is not None:
            try:
                write_message(stream, message)
            except BrokenPipeError:
                return
        with suppress(BrokenPipeError):
            stream.close()

    def _receive(self) -> None:
        stream = self._process.stdout
        assert stream is not None
        while (message := read_message(stream)) is not None:
            near = [_unpack_scan(scan, self._sensors) for scan in _split(message, "near")]
            self._incoming.append(Correction(message["T_map_local"], message["poses"], near))


def _pack_scan(scan: MappedScan, sensor: int) -> dict[str, NDArray[Any]]:
    beams = scan.beams
    return {
        "stamp_ns": np.array(beams.stamp_ns),
        "points": beams.points,
        "hit": beams.hit,
        "T_base_sensor": beams.T_base_sensor,
        "sensor": np.array(sensor),
        "e": scan.e,
        "T_map_base": scan.T_map_base,
        "travelled": np.array(scan.travelled),
    }


def _unpack_scan(message: dict[str, NDArray[Any]], sensors: list[str | int]) -> MappedScan:
    beams = ScanBeams(
        int(message["stamp_ns"]),
        message["points"],
        message["hit"],
        message["T_base_sensor"],
        sensors[int(message["sensor"])],
    )
    return MappedScan(beams, message["e"], message["T_map_base"], float(message["travelled"]))


def _split(message: dict[str, NDArray[Any]], prefix: str) -> list[dict[str, NDArray[Any]]]:
    """The parts of a message whose names are PREFIX.NUMBER.NAME."""
    parts: dict[int, dict[str, NDArray[Any]]] = {}
    for key, value in message.items():
        if key.startswith(f"{prefix}."):
            _, number, name = key.split(".")
            parts.setdefault(int(number), {})[name] = value
    return [parts[k] for k in sorted(parts)]


def _pack_correction(found: Correction) -> dict[str, NDArray[Any]]:
    out = {"T_map_local": found.T_map_local, "poses": found.poses}
    for k, scan in enumerate(found.near):
        assert isinstance(scan.beams.sensor, int)
        packed = _pack_scan(scan, scan.beams.sensor)
        out |= {f"near.{k}.{name}": value for name, value in packed.items()}
    return out


class _Numbered(list[Any]):
    """Sensors in the child are numbers."""

    def __getitem__(self, key: Any) -> Any:
        return key


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


def _serve(settings: dict[str, Any], source: IO[bytes], target: IO[bytes]) -> None:
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
    while (message := arrived.get()) is not None:
        scan = _unpack_scan(message, _Numbered())
        closer.add(scan, float(message["explained"]), message["drift"])
        if arrived.empty() and (found := closer.poll()) is not None:
            write_message(target, _pack_correction(found))


def main() -> None:
    """Serve the process that started this one."""
    try:
        _serve(json.loads(sys.argv[1]), sys.stdin.buffer, sys.stdout.buffer)
    except BrokenPipeError:
        os._exit(0)  # the other process has ended
    except Exception:
        traceback.print_exc()
        os._exit(1)  # at once: a thread still reads


if __name__ == "__main__":
    main()
