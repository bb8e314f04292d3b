"""Memory: what this process may use, a limit on it, and errors when it is exceeded.

The limit is `RLIMIT_DATA`: allocations beyond it fail, so that the process can say so before the
system kills it. Files that are mapped do not count. Systems without `/proc` have no limit.
"""

import errno
import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from stillmap.core.errors import InputError

GIGABYTE = 1e9

_SHARE = 0.8  # of the available memory that a run may use, where nothing is said

_MORE = "memory=GB allows more, where the machine has it"
_PROCESS = Path("/proc/self/status")
_MACHINE = Path("/proc/meminfo")
_GROUPS = Path("/proc/self/cgroup")
_CONTROL = Path("/sys/fs/cgroup")


class _GroupFiles(NamedTuple):
    """Names of the files of a control group: limit, use, and the line of its reclaimable cache."""

    limit: str
    used: str
    cache: str


_UNIFIED = _GroupFiles("memory.max", "memory.current", "inactive_file")
_SEPARATE = _GroupFiles("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")

_allowed: int | None = None  # bytes, within `limit_memory`
_before = resource.RLIM_INFINITY  # the limit outside it


@contextmanager
def limit_memory(allowed: int) -> Iterator[None]:
    """Let allocations fail by which the process would exceed `allowed` bytes in total."""
    global _allowed, _before
    import numpy as np  # noqa: F401  the stacks of its threads are reserved from here on

    _before, most = resource.getrlimit(resource.RLIMIT_DATA)
    known = _read_table(_PROCESS)
    _allowed = allowed
    if "VmData" in known and "VmRSS" in known:
        # what is reserved but not used does not count
        limit = known["VmData"] + max(allowed - known["VmRSS"], 0)
        _set_limit(min([limit, *(one for one in (_before, most) if one != resource.RLIM_INFINITY)]))
    try:
        yield
    finally:
        _set_limit(_before)
        _allowed = None


def _set_limit(soft: int) -> None:
    with suppress(OSError, ValueError):
        resource.setrlimit(
            resource.RLIMIT_DATA, (soft, resource.getrlimit(resource.RLIMIT_DATA)[1])
        )


def require_memory(needed: float, what: str, hint: str = "") -> None:
    """Refuse work that takes more memory than is allowed, before it begins.

    Args:
        needed: bytes, at least.
        what: the subject of the message.
        hint: what would take less.

    Raises:
        InputError: it does not fit.
    """
    allowed = allowed_memory()
    if needed <= allowed:
        return
    raise InputError(
        f"{what} takes at least {needed / GIGABYTE:.3g} GB of memory, and "
        f"{allowed / GIGABYTE:.3g} GB may be used",
        hint=_join(hint, _MORE),
    )


def default_memory() -> int:
    """Bytes in total that this process may use where the user says nothing: those that it uses
    already, and a share of what is available."""
    return _read_table(_PROCESS).get("VmRSS", 0) + round(_SHARE * available_memory())


def allowed_memory() -> int:
    """Bytes that this process may use in total, within `limit_memory`; else what is available."""
    return available_memory() if _allowed is None else _allowed


def is_out_of_memory(error: BaseException) -> bool:
    """True if memory ran out, whichever library says so."""
    if isinstance(error, OSError):
        return error.errno == errno.ENOMEM
    no_thread = isinstance(error, RuntimeError) and "start new thread" in str(error)
    return no_thread or isinstance(error, MemoryError)


def memory_error(error: BaseException, hint: str = "") -> InputError:
    """The error for memory that ran out; within `limit_memory` its limit, which ends here."""
    if _allowed is None:
        return InputError(f"not enough memory{': ' if str(error) else ''}{error}", hint=hint)
    _set_limit(_before)  # what is done about it takes some as well
    return InputError(
        f"not enough memory: it takes more than the {_allowed / GIGABYTE:.3g} GB that may be used",
        hint=_join(_MORE, hint),
    )


def _join(*hints: str) -> str:
    return "; ".join(filter(None, hints))


def total_memory() -> int:
    """Bytes that the machine has, or the control group may use, all processes together."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return min([total, *(limit for limit, _ in _group_limits())])


def available_memory() -> int:
    """Bytes that this process may still use: of the machine, its control group, and its limits."""
    found = [limit - used for limit, used in _group_limits()]
    machine = _read_table(_MACHINE)
    found.append(machine.get("MemAvailable", total_memory()))
    known = _read_table(_PROCESS)
    for kind, name in ((resource.RLIMIT_AS, "VmSize"), (resource.RLIMIT_DATA, "VmData")):
        limit = resource.getrlimit(kind)[0]
        if limit != resource.RLIM_INFINITY:
            found.append(limit - known.get(name, 0))
    return max(min(found), 0)


def _group_limits() -> Iterator[tuple[int, int]]:
    """Limit and use in bytes of the control groups of this process, without cache."""
    for line in _read_lines(_GROUPS):
        number, controllers, place = (*line.split(":", 2), "", "")[:3]
        if number == "0":
            root, files = _CONTROL, _UNIFIED
        elif "memory" in controllers.split(","):
            root, files = _CONTROL / "memory", _SEPARATE
        else:
            continue
        inside = root / place.strip("/")
        # in a container, the group itself is what is mounted
        for folder in {root, inside, *inside.parents}:
            if folder == root or root in folder.parents:
                yield from _limits_in(folder, files)


def _limits_in(folder: Path, files: _GroupFiles) -> Iterator[tuple[int, int]]:
    limit, used = (next(iter(_read_lines(folder / name)), "") for name in (files.limit, files.used))
    if not limit.isdigit():  # `max`: none
        return
    words = (line.split() for line in _read_lines(folder / "memory.stat"))
    cache = sum(int(one[1]) for one in words if len(one) == 2 and one[0] == files.cache)
    yield int(limit), max(int(used) - cache, 0) if used.isdigit() else 0


def _read_lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return []


def _read_table(path: Path) -> dict[str, int]:
    """Bytes by name of a file with lines such as `VmRSS:  1234 kB`."""
    out = {}
    for line in _read_lines(path):
        name, _, value = line.partition(":")
        words = value.split()
        if len(words) == 2 and words[1] == "kB" and words[0].isdigit():
            out[name] = 1024 * int(words[0])
    return out
