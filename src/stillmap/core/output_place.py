"""Paths of outputs and of their temporary files; symbolic links are followed.

Usually that is beside the output, so that a rename makes it appear. A folder that cannot be renamed
(a mount point, or one in a folder that must not be changed) has the hidden names inside.
"""

import hashlib
import os
import re
import stat
import tempfile
from pathlib import Path

from stillmap.core.errors import InputError, cannot_write

PREFIX = ".stillmap."  # of hidden names inside an output
UNFINISHED = f"{PREFIX}unfinished"  # the journal of a folder whose files are being exchanged

# bytes of a name to which something is added: file systems allow 255, and SQLite 512 of a path
_MAX_STEM = 100
_RANDOM = re.compile(r"[0-9a-f]{16}\.(part|old)")
_OF_DISKS = "lost+found"  # in the uppermost folder of a disk
_MOUNTS = Path("/proc/self/mountinfo")
_ESCAPE = re.compile(rb"\\([0-7]{3})")


def resolve_output(path: Path) -> Path:
    """The absolute path of an output without links: what they point to is replaced, not they.

    Raises:
        InputError: links lead to each other, or no file can have such a name there.
    """
    found = Path(os.path.realpath(path))
    try:
        is_loop = stat.S_ISLNK(found.lstat().st_mode)
    except (FileNotFoundError, NotADirectoryError):
        is_loop = False
    except OSError as error:
        raise cannot_write(error, path) from error
    if is_loop:
        raise InputError("is a link that leads to itself", where=str(path))
    return found


def is_fixed(folder: Path) -> bool:
    """True if a folder, given without links, cannot be renamed."""
    if not folder.is_dir():
        return False
    parent = folder.parent
    if os.path.ismount(folder) or os.fsencode(folder) in _mount_points():
        return True
    if not os.access(parent, os.W_OK | os.X_OK):
        return True
    above, user = parent.stat(), os.geteuid()
    is_sticky = bool(above.st_mode & stat.S_ISVTX)  # as /tmp: only owners rename
    return is_sticky and user not in (0, above.st_uid, folder.stat().st_uid)


def workplace(output: Path) -> Path:
    """The folder for temporary files of an output, on its disk where that is possible.

    Raises:
        InputError: see `resolve_output`.
    """
    target = resolve_output(output)
    if is_fixed(target):
        return target
    if target.is_file() and not os.access(target.parent, os.W_OK | os.X_OK):
        return Path(tempfile.gettempdir())
    return target.parent


def hidden_path(output: Path, suffix: str) -> Path:
    """A hidden name for what belongs to an output, in `workplace`; the same for equal arguments.

    Args:
        output: file or folder.
        suffix: end of the name.
    """
    target, folder = resolve_output(output), workplace(output)
    if folder == target:
        return folder / f"{PREFIX}{suffix}"
    return folder / f".{shorten(target.name)}.{suffix}"


def is_temporary(name: str, output: Path) -> bool:
    """True if an entry of `workplace` has a name that `hidden_path` gives to unfinished work."""
    head = hidden_path(output, "").name
    return name.startswith(head) and _RANDOM.fullmatch(name[len(head) :]) is not None


def shorten(name: str) -> str:
    """A name to which something can be added; the same for equal names, another for others."""
    if len(os.fsencode(name)) <= _MAX_STEM:
        return name
    digest = hashlib.sha256(os.fsencode(name)).hexdigest()[:8]
    while len(os.fsencode(name)) > _MAX_STEM - len(digest) - 1:
        name = name[:-1]
    return f"{name}-{digest}"


def list_entries(folder: Path) -> list[str]:
    """Names in a folder, without the hidden ones of unfinished work."""
    names = os.listdir(folder)
    return [name for name in names if not name.startswith(PREFIX) and name != _OF_DISKS]


def require_finished(folder: Path) -> None:
    """Reject a folder in which the exchange of files was interrupted.

    Raises:
        InputError: it is one.
    """
    if os.path.lexists(folder / UNFINISHED):
        hint = "write it again with overwrite=True"
        raise InputError("is not whole: writing it was interrupted", where=str(folder), hint=hint)


def _mount_points() -> set[bytes]:
    """Paths at which something is mounted; those on the same disk as well, which look like any."""
    try:
        lines = _MOUNTS.read_bytes().splitlines()
    except OSError:  # no Linux
        return set()
    fields = (line.split(b" ", 5) for line in lines)
    found = (row[4] for row in fields if len(row) == 6)
    return {_ESCAPE.sub(lambda octal: bytes([int(octal[1], 8)]), path) for path in found}
