"""Signals that end a live run, after which the result is written."""

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from stillmap.core.interrupts import defers_signals_in, send_again


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
