"""Files that exist only to be locked."""

import os
import stat
from pathlib import Path
from typing import IO

from stillmap.core.errors import InputError


def open_lock(path: Path) -> IO[bytes]:
    """Open a lock file, which is made where it is missing.

    Raises:
        InputError: something else is there: to open a pipe waits for its reader.
        OSError: it cannot be opened, or it is a link.
    """
    flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC
    try:
        handle = os.open(path, flags, 0o666)
    except OSError as error:
        if path.exists() and not path.is_file():
            raise _irregular_error(path) from error
        raise
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise _irregular_error(path)
    return os.fdopen(handle, "ab")


def _irregular_error(path: Path) -> InputError:
    return InputError("is in the way: no regular file", where=str(path))
