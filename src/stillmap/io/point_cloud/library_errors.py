"""Errors of libraries about damaged files as errors of input."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from stillmap.core.errors import InputError


@contextmanager
def library_errors(path: Path) -> Iterator[None]:
    """Turn errors of a library about damaged bytes into InputError."""
    try:
        with np.errstate(all="ignore"):
            yield
    except (InputError, MemoryError):
        raise
    except BaseException as error:
        # panics of Rust derive from BaseException
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        raise damaged_error(path, error) from error


def damaged_error(path: Path, error: BaseException) -> InputError:
    """The error for a file on which a library fails."""
    what = (str(error).splitlines() or [type(error).__name__])[0]
    return InputError(f"is damaged: {what}", where=str(path))
