"""One command of stillmap as a child process that is measured and ends with its parent."""

import json
import os
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

_SUPERVISOR = Path(__file__).with_name("supervisor.py")
# -P: a file of the working directory is never taken for a module
_STILLMAP = (sys.executable, "-P", "-m", "stillmap")

_POLL = 0.1  # s between two looks at the order to stop
_GRACE = 5.0  # s for a child to clean up before it is killed
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Stopped(Exception):
    """The child was ended because the whole run is to stop."""


class Ended(NamedTuple):
    """How a child ended.

    Attributes:
        status: its exit status; negative: the signal that ended it.
        stdout, stderr: what it printed.
        cpu_seconds: user and system time.
        peak_memory_bytes: resident.
    """

    status: int
    stdout: str
    stderr: str
    cpu_seconds: float
    peak_memory_bytes: int


def run_stillmap(words: list[str], stop: threading.Event | None = None) -> Ended:
    """Run a command of stillmap in a process of its own.

    Args:
        words: its command line.
        stop: ends the child when it is set.

    Raises:
        Stopped: `stop` was set.
        OSError: no process can be started.
    """
    reading, writing = os.pipe()
    with open(reading, encoding="ascii") as report:
        try:
            process = subprocess.Popen(
                [
                    *(sys.executable, "-I", "-S", str(_SUPERVISOR), str(writing)),
                    *(str(os.getpid()), *_STILLMAP, *words),
                ],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                errors="backslashreplace",
                pass_fds=(writing,),
                start_new_session=True,  # Ctrl-C at the terminal is the parent's alone
                env=_environment(),
            )
        finally:
            os.close(writing)
        with process:
            try:
                out, err = _wait(process, stop)
            finally:
                _end(process)
        return _ended(process, report.read(), out, err)


def _environment() -> dict[str, str]:
    """One thread of each BLAS, unless the user says otherwise: tasks run side by side."""
    return {**dict.fromkeys(_THREAD_VARIABLES, "1"), **os.environ}


def _wait(process: "subprocess.Popen[str]", stop: threading.Event | None) -> tuple[str, str]:
    while True:
        with suppress(subprocess.TimeoutExpired):
            return process.communicate(timeout=None if stop is None else _POLL)
        if stop is not None and stop.is_set():
            raise Stopped


def _end(process: "subprocess.Popen[str]") -> None:
    """End the supervisor and its child, which first gets time to remove its temporary files."""
    if process.poll() is not None:
        return
    process.terminate()
    with suppress(subprocess.TimeoutExpired):
        process.wait(_GRACE)
        return
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)


def _ended(process: "subprocess.Popen[str]", report: str, out: str, err: str) -> Ended:
    if not report:  # the supervisor itself was killed, and its child with it
        return Ended(min(process.returncode, -1), out, err, 0.0, 0)
    found = json.loads(report)
    return Ended(
        int(found["status"]),
        out,
        err,
        float(found["cpu_seconds"]),
        int(found["peak_memory_bytes"]),
    )
