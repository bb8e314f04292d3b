"""Reads one input of every kind in a process that may open nothing else, and no socket.

python read_alone.py FOLDER      prints what was opened in spite of that, and `all read`

Sockets are forbidden to libraries, too: with the first one the kernel ends the process (SIGSYS).
"""

import ctypes
import os
import platform
import struct
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parent))

from faulty_inputs import RECORDINGS, fetching_e57

from stillmap.cli.main import main

_SOCKET = {"x86_64": 41, "aarch64": 198}.get(platform.machine())  # number of the system call
_NO_NEW_PRIVILEGES, _SECCOMP, _FILTER = 38, 22, 2
_LOAD, _JUMP_IF_EQUAL, _RETURN = 0x20, 0x15, 0x06
_KILL, _ALLOW = 0x80000000, 0x7FFF0000

_FORBIDDEN = (
    *("socket.connect", "socket.bind", "socket.getaddrinfo", "socket.gethostbyname"),
    *("urllib.Request", "subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.fork"),
)


_SYSTEM = ("/proc/self/", "/proc/meminfo\0", "/sys/fs/cgroup/")  # what memory may be used


def forbid_sockets() -> bool:
    """Let the kernel end this process at its next socket; False: it cannot."""
    if _SOCKET is None or sys.platform != "linux":
        return False
    steps = [
        (_LOAD, 0, 0, 0),
        (_JUMP_IF_EQUAL, 0, 1, _SOCKET),
        (_RETURN, 0, 0, _KILL),
        (_RETURN, 0, 0, _ALLOW),
    ]
    code = ctypes.create_string_buffer(b"".join(struct.pack("=HBBI", *step) for step in steps))
    program = ctypes.create_string_buffer(struct.pack("HL", len(steps), ctypes.addressof(code)))
    library = ctypes.CDLL(None, use_errno=True)
    if library.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0):
        return False
    return not library.prctl(_SECCOMP, _FILTER, ctypes.byref(program), 0, 0)


def watch(allowed: Callable[[], list[str]]) -> list[str]:
    """What is opened from now on outside of the folders that are allowed at the time."""
    found: list[str] = []
    own = [sys.prefix, sys.base_prefix, os.path.dirname(os.path.dirname(main.__code__.co_filename))]

    def look(event: str, details: tuple[object, ...]) -> None:
        if event in _FORBIDDEN:
            found.append(f"{event} {details}")
        if event not in ("open", "sqlite3.connect") or isinstance(details[0], int):
            return
        name = details[0]
        path = os.fsdecode(name) if isinstance(name, str | bytes | os.PathLike) else str(name)
        path = os.path.abspath(path.removeprefix("file:").partition("?")[0])
        if not f"{path}\0".startswith((*own, *allowed(), *_SYSTEM, "/dev/null\0")):
            found.append(f"{event} {path}")

    sys.addaudithook(look)
    return found


def read_all(folder: Path) -> None:
    made = []
    for number, reader in enumerate({one.make: one for one in RECORDINGS}.values()):
        home = folder / f"{number}"
        home.mkdir()
        made.append((reader, home, reader.make(home)))
        main(reader.command(made[-1][2], folder / f"first-{number}"))  # loads libraries
    net = fetching_e57(folder)
    scratch = tempfile.gettempdir()  # found by attempts to write
    here = [""]
    found = watch(lambda: here)
    if not forbid_sockets():
        print("sockets cannot be forbidden here")
    for number, (reader, home, path) in enumerate(made):
        output = folder / f"second-{number}"
        here[:] = [f"{one}" for one in (home, output, f"{folder}/.second-{number}.")]
        here += [f"{scratch}/.stillmap-", f"{folder}\0"]  # temporary files in it
        status = main(reader.command(path, output))
        if status:
            print(f"{reader.name}: exit status {status}")
    here[:] = [str(net)]
    if main(["info", str(net)]) != 2:
        print("a schema is not refused")
    for one in found:
        print(one)
    print("all read")


if __name__ == "__main__":
    read_all(Path(sys.argv[1]))
