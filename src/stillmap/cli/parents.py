"""Folders that an output is to lie in."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from stillmap.errors import InputError


@contextmanager
def parents_made(output: Path) -> Iterator[None]:
    """Makes the folders above an output that are not there; they go again where the block fails.

    Raises:
        InputError: they cannot be made, or nothing can be written there. Nothing was read yet.
    """
    parent = Path(os.path.abspath(output)).parent
    made: list[Path] = []
    try:
        try:
            for folder in reversed((parent, *parent.parents)):
                if not folder.exists():
                    folder.mkdir(exist_ok=True)
                    made.append(folder)
            # a device in the way is told of by who writes
            if not output.exists() or output.is_file() or output.is_dir():
                tempfile.TemporaryFile(dir=parent).close()
        except OSError as error:
            what = f"cannot be written: {error.strerror or error}"
            raise InputError(what, where=str(output)) from error
        yield
    except BaseException:
        with suppress(OSError):  # something may lie in them by now
            for folder in reversed(made):
                folder.rmdir()
        raise
