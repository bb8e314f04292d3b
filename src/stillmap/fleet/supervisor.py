"""A small process between a worker and the `stillmap` that it runs; the standard library alone.

    python -I -S supervisor.py DESCRIPTOR PARENT COMMAND...

It runs COMMAND as its child, ends it when PARENT has ended, and writes exit status, CPU time and
peak memory of the child to the open file DESCRIPTOR as JSON. It exists because a process that is
started from a large one inherits that one's peak memory in its own account (Linux), and because
nothing may be called between fork and exec in a process of several threads.
"""

import json
import os
import resource
import signal
import sys
from contextlib import suppress

_PERIOD = 1.0  # s between two looks at the parent, where the system does not tell of its end
_PR_SET_PDEATHSIG = 1


def main(descriptor: int, parent: int, command: list[str]) -> None:
    """Run the command, and report how it ended."""
    _end_with(parent)
    me, child = os.getpid(), os.fork()
    if child == 0:
        os.close(descriptor)
        _end_with(me)
        os.execv(command[0], command)
    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
        signal.signal(number, lambda *_: _send(child, signal.SIGTERM))
    signal.signal(signal.SIGALRM, lambda *_: _kill_orphan(parent, child))
    signal.setitimer(signal.ITIMER_REAL, _PERIOD, _PERIOD)
    _, status, used = os.wait4(child, 0)
    signal.setitimer(signal.ITIMER_REAL, 0)
    os.write(descriptor, json.dumps(_describe(status, used)).encode())


def _end_with(parent: int) -> None:
    """Have the kernel kill this process as soon as its parent has ended (Linux)."""
    if sys.platform == "linux":
        import ctypes

        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it ended before
        os._exit(1)


def _kill_orphan(parent: int, child: int) -> None:
    if os.getppid() != parent:
        _send(child, signal.SIGKILL)


def _send(child: int, number: signal.Signals) -> None:
    with suppress(ProcessLookupError):  # it has just ended
        os.kill(child, number)


def _describe(status: int, used: resource.struct_rusage) -> dict[str, float]:
    unit = 1 if sys.platform == "darwin" else 1024  # bytes of ru_maxrss
    return {
        "status": os.waitstatus_to_exitcode(status),
        "cpu_seconds": used.ru_utime + used.ru_stime,
        "peak_memory_bytes": used.ru_maxrss * unit,
    }


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3:])
