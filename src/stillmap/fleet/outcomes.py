"""How the tasks of a fleet end."""

import errno
import os
from dataclasses import dataclass, field
from typing import Any, Literal

from stillmap.fleet.child import Ended
from stillmap.fleet.storage import UnreachableError

Status = Literal["done", "failed", "killed", "unreachable", "full"]

_INPUT_AT_FAULT = 2  # exit status of stillmap
_STOPPED_BY_SIGNAL = (130, 143)  # the same, after a Ctrl-C and a SIGTERM from outside
DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
MAKE_ROOM = "make room, then continue with the same command"
_FULL = tuple(map(os.strerror, DISK_FULL))


@dataclass(frozen=True)
class Outcome:
    """How a task ended.

    Attributes:
        status: `done`; `failed`, not to be tried again; `killed`, or `unreachable` where a bucket
            did not answer as it should, to be tried again; `full`: a disk is full, no task can go
            on.
        why: one line; empty where it is done.
        found: what it found out, JSON-able.
        cpu_seconds: of its child processes.
        peak_memory_bytes: of the largest of them.
        worker: which worker ran it, for trying elsewhere.
    """

    status: Status
    why: str = ""
    found: dict[str, Any] = field(default_factory=dict)
    cpu_seconds: float = 0.0
    peak_memory_bytes: int = 0
    worker: str = ""


def outcome_of(ended: Ended, **found: Any) -> Outcome:
    """The outcome of a child process."""
    used = {"cpu_seconds": ended.cpu_seconds, "peak_memory_bytes": ended.peak_memory_bytes}
    if ended.status == 0:
        return Outcome("done", "", found, **used)  # type: ignore[arg-type]
    line = (ended.stderr.strip().splitlines() or ["it says nothing"])[-1]
    line = line.removeprefix("stillmap: ")
    if ended.status < 0 or ended.status in _STOPPED_BY_SIGNAL:
        number = -ended.status if ended.status < 0 else ended.status - 128
        return Outcome("killed", f"was ended by signal {number}", **used)  # type: ignore[arg-type]
    if any(text in line for text in _FULL):
        return Outcome("full", line, **used)  # type: ignore[arg-type]
    why = line if ended.status == _INPUT_AT_FAULT else f"a defect of stillmap: {line}"
    return Outcome("failed", why, **used)  # type: ignore[arg-type]


def outcome_of_error(error: Exception) -> Outcome:
    """The outcome of a task that raised an error before or after its child process."""
    line = str(error)
    if any(text in line for text in _FULL):
        return Outcome("full", line)
    if isinstance(error, UnreachableError):
        return Outcome("unreachable", line)
    if isinstance(error, OSError):
        return Outcome("failed", f"{error.filename or 'the result'}: {error.strerror or error}")
    return Outcome("failed", line)
