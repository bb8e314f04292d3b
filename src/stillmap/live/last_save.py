"""The end of a drive: what was mapped is not lost, whatever became of the disk of its result."""

import logging
import os
import shlex
import tempfile
import time
from contextlib import suppress
from pathlib import Path

from stillmap.core.errors import InputError, cannot_write
from stillmap.core.files import nearest_folder_above, new_folder
from stillmap.core.profiling import Progress, no_progress
from stillmap.live.drive_folder import keep_drive
from stillmap.live.saving import LiveResult, Snapshot

_PATIENCE = 600.0  # s for which it is tried again where no disk has room
_PAUSE = 5.0  # s between two attempts

_log = logging.getLogger(__name__)


def save_last(
    snapshot: Snapshot, output: Path, *, overwrite: bool = False, progress: Progress = no_progress
) -> None:
    """Write the result of a drive that has ended. If it cannot be written, it is kept among
    temporary files, or else the drive is, for `stillmap live --drive`; while neither is possible,
    it is tried again.

    Args:
        snapshot: of the drive.
        output: result folder.
        overwrite: replace an earlier result there.
        progress: how far it is.

    Raises:
        InputError: it is not in its folder; says where it is.
        KeyboardInterrupt: by Ctrl-C. What is kept is whole; a log message says where.
    """
    attempt = _Attempt(snapshot, output, overwrite, progress)
    try:
        _save_or_keep(attempt)
    except InputError:
        raise
    except BaseException:  # an interruption, or a defect: nobody drives the same way again
        if (hint := attempt.keep_drive()) is not None:
            _log.warning(hint)
        raise


class _Attempt:
    """Ways of saving a drive; the result is made once."""

    def __init__(
        self, snapshot: Snapshot, output: Path, overwrite: bool, progress: Progress
    ) -> None:
        self._snapshot, self._output = snapshot, output
        self._overwrite, self._progress = overwrite, progress
        self._result: LiveResult | None = None

    def save(self) -> None:
        """Write the result where it should be.

        Raises:
            InputError, OSError: it cannot be written.
        """
        self._prepare(self._output).write(self._output, self._overwrite)

    def keep_result(self) -> str | None:
        """Write the result among temporary files; tells where, or None: there is no room."""
        try:
            with new_folder("stillmap-live-") as spare:
                self._prepare(spare / "map").write(spare)
        except (InputError, OSError):
            return None
        return f"the result is kept in {spare}"

    def keep_drive(self) -> str | None:
        """Keep the drive; tells how it is saved later, or None: there is no room."""
        scratch = self._snapshot.scratch
        # where its temporary files are, but not in a folder that is removed with them
        beside = Path(tempfile.gettempdir()) if scratch is None else nearest_folder_above(scratch)
        for parent in (beside, nearest_folder_above(self._output)):
            with suppress(OSError):
                folder = keep_drive(self._snapshot, parent)
                words = ["stillmap", "live", "--drive", str(folder), "-o", str(self._output)]
                return f"the drive is kept; save it with: {shlex.join(words)}"
        return None

    def _prepare(self, path: Path) -> LiveResult:
        if self._result is None:
            self._result = self._snapshot.prepare(path, self._progress)
        return self._result


def _save_or_keep(attempt: _Attempt) -> None:
    """Save a drive, or keep what could not be saved.

    Raises:
        InputError: it is not in its folder.
    """
    try:
        attempt.save()
    except (InputError, OSError) as error:
        _keep_or_try_again(attempt, error)


def _keep_or_try_again(attempt: _Attempt, first: InputError | OSError) -> None:
    """Keep what could not be saved; while there is no room at all, try to save it again.

    Raises:
        InputError: it is kept, or there was never room.
    """
    error = _to_input_error(first)
    until, told = time.monotonic() + _PATIENCE, False
    while True:
        hint = attempt.keep_result() or attempt.keep_drive()
        if hint is not None:
            raise InputError(error.what, where=error.where, hint=hint) from first
        if time.monotonic() > until:
            raise error from first
        if not told:
            minutes = _PATIENCE / 60.0
            _log.warning(
                "%s; nor is there room in %s. Trying again for %.0f minutes: make room, or give "
                "the drive up with Ctrl-C",
                error,
                tempfile.gettempdir(),
                minutes,
            )
            told = True
        time.sleep(_PAUSE)
        with suppress(InputError, OSError):
            attempt.save()
            return


def _to_input_error(error: InputError | OSError) -> InputError:
    if isinstance(error, InputError):
        return error
    return cannot_write(error, os.fspath(error.filename or tempfile.gettempdir()))
