"""A recording pushed through the live mapper, as fast as possible or at its own pace."""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import Any

import numpy as np

from stillmap.core.array_types import Float
from stillmap.core.interrupts import defers_signals_in, send_again
from stillmap.core.profiling import Progress, no_progress, peak_memory_bytes
from stillmap.core.recording import Recording
from stillmap.live.mapper import LiveMapper
from stillmap.live.scan import ScanBeams
from stillmap.live.update import Update

Show = Callable[[LiveMapper, ScanBeams, Update], None]


@dataclass(frozen=True, eq=False)
class Latency:
    """Seconds from a scan to its answer, of T scans.

    Attributes:
        seconds: (T,).
        dropped: number of scans that could not be used.
        peak_memory_bytes: of the process.
    """

    seconds: Float
    dropped: int
    peak_memory_bytes: int

    def to_dict(self) -> dict[str, Any]:
        """As `stillmap live --json` prints it."""
        ms = 1e3 * self.seconds if len(self.seconds) else np.zeros(1)
        return {
            "scans": len(self.seconds),
            "dropped": self.dropped,
            "latency_ms": {
                "median": round(float(np.median(ms)), 3),
                "p99": round(float(np.quantile(ms, 0.99)), 3),
                "max": round(float(ms.max()), 3),
            },
            "peak_memory_bytes": self.peak_memory_bytes,
        }


def replay(
    recording: Recording,
    mapper: LiveMapper,
    progress: Progress = no_progress,
    rate: float | None = None,
    show: Show | None = None,
    stop: threading.Event | None = None,
) -> Latency:
    """Push the scans of a recording.

    Args:
        recording: in 2D or 3D.
        mapper: that takes them.
        progress: called with the number of scans done and their total.
        rate: times the speed of the recording: a latency counts from when the scan is due, and a
            scan is dropped where the next one is due already. None: one after another.
        show: called with each scan and its answer.
        stop: ends it early.
    """
    stop = stop or threading.Event()
    seconds, dropped, begin = list[float](), 0, time.perf_counter()
    due = np.zeros(recording.n_scans)
    if rate is not None:
        due = 1e-9 * (recording.stamp_ns - recording.stamp_ns[0]) / rate
    for t, beams in enumerate(iter_beams(recording)):
        if rate is not None:
            if t + 1 < len(due) and time.perf_counter() - begin > due[t + 1]:
                dropped += 1
                continue
            stop.wait(max(begin + float(due[t]) - time.perf_counter(), 0.0))
        if stop.is_set():
            break
        odometry = None if recording.T_odom_base is None else recording.T_odom_base[t]
        start = time.perf_counter() if rate is None else begin + float(due[t])
        update = mapper.push(beams, odometry)
        seconds.append(time.perf_counter() - start)
        if show is not None:
            show(mapper, beams, update)
        mapper.update_map()
        progress("mapping", 0, t + 1, recording.n_scans)
    return Latency(np.array(seconds), dropped, peak_memory_bytes())


def iter_beams(recording: Recording) -> Iterator[ScanBeams]:
    """The scans of a recording, as they would arrive."""
    for t in recording.iter_scans(range(recording.n_scans)):
        yield ScanBeams.of(recording, t)


@contextmanager
def signal_flag() -> Iterator[threading.Event]:
    """An event that Ctrl-C, SIGTERM and SIGHUP, the end of the terminal, set.

    `ros2 launch` sends SIGTERM some seconds after Ctrl-C, and a terminal sends Ctrl-C to the node
    and to launch alike: what comes while the result is written must not end it. Only Ctrl-C more
    than a second after the first one does.
    """
    stop, since = threading.Event(), [0.0]

    def handle(number: int, frame: FrameType | None) -> None:
        if number == signal.SIGINT and stop.is_set() and time.monotonic() - since[0] > 1.0:
            if defers_signals_in(frame):
                send_again(number)
                return
            raise KeyboardInterrupt
        if not stop.is_set():
            since[0] = time.monotonic()
            stop.set()

    numbers = [signal.SIGTERM, signal.SIGHUP, signal.SIGINT]
    before = {number: signal.getsignal(number) for number in numbers}
    for number, handler in before.items():
        if handler is not signal.SIG_IGN:  # as a shell script leaves it in the background
            signal.signal(number, handle)
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
