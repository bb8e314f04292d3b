"""The folder beside a result in which a run keeps its checkpoints, locked while it runs.

`.NAME.resume/` beside NAME (`.stillmap.resume/` inside, where NAME is a mount point) holds `lock`,
and `iteration-K/` once iteration K is finished: flat arrays and `state.json`, which knows the
checksum of each. A checkpoint is written beside the one before, which goes only when the new one is
whole and on the disk.
"""

import fcntl
import json
import os
import re
import shutil
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Annotated, Any, NotRequired, TypedDict

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_files import open_npy
from stillmap.core.arrays import iter_bytes, write_npy
from stillmap.core.config import Limits
from stillmap.core.errors import InputError, cannot_write
from stillmap.core.files import sync
from stillmap.core.interrupts import defer_signals
from stillmap.core.json import read_json
from stillmap.core.locks import open_lock
from stillmap.core.output_place import hidden_path, resolve_output
from stillmap.core.profiling import StageTimer
from stillmap.core.publishing import finish_exchange
from stillmap.core.recording import Recording
from stillmap.core.schema import check
from stillmap.pipeline.checkpoint_checks import check_state
from stillmap.pipeline.checkpoint_files import pack_state, require_same_run, unpack_state
from stillmap.pipeline.estimate import EmState
from stillmap.pipeline.options import Options

_FORMAT_VERSION = 3
_STATE, _LOCK = "state.json", "lock"
_NAME = re.compile(r"[A-Za-z0-9_.-]+")
_LARGEST_STATE = 1 << 30  # bytes
_IN_MEMORY = 1 << 20  # bytes of an array that is read at once instead of mapped


_Seconds = Annotated[float, Limits(ge=0.0)]


class _Stage(TypedDict):
    """Of a StageTimer."""

    seconds: _Seconds
    cpu_seconds: _Seconds
    peak_memory_bytes: NotRequired[Annotated[int, Limits(ge=0)]]


class DamagedCheckpoint(Exception):
    """A checkpoint that cannot be used; names the file and the reason."""


class CheckpointFolder:
    """The checkpoints of one run; see `lock_checkpoints`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._arrays: dict[str, dict[str, Any]] = {}  # those of the present checkpoint
        self.is_in_use = False  # the newest checkpoint is of this run

    @property
    def newest(self) -> Path | None:
        """The last complete checkpoint; None where there is none."""
        if not self.folder.is_dir():  # somebody has removed it
            return None
        numbers = [
            int(path.name.removeprefix("iteration-"))
            for path in self.folder.iterdir()
            if re.fullmatch(r"iteration-[0-9]{1,9}", path.name)
        ]
        return self.folder / f"iteration-{max(numbers)}" if numbers else None

    def load(
        self,
        identity: Mapping[str, Any],
        options: Options,
        recording: Recording,
        stages: StageTimer,
    ) -> EmState | None:
        """The state of the run at its last checkpoint; None where there is none.

        Args:
            identity: of the run, see `identify_run`.
            options: of the run, resolved.
            recording: that is mapped.
            stages: the time that the run took so far is added here.

        Raises:
            InputError: it is of another recording or other options.
            DamagedCheckpoint: a file differs from what was written.
        """
        if self.newest is None:
            return None
        state = _state(self.newest / _STATE)
        try:
            require_same_run(state["identity"], dict(identity), str(self.folder))
            arrays = {
                name: _array(self.newest / f"{name}.npy", about)
                for name, about in state["arrays"].items()
            }
            run = unpack_state(state["state"], arrays, options)
            check_state(run, recording)
            check(state["stages"], dict[str, _Stage], "stages")
            stages.add(state["stages"])
        except (InputError, DamagedCheckpoint):
            raise
        except Exception as error:  # whatever comes of values that no run has written
            raise DamagedCheckpoint(f"{self.newest / _STATE}: {error!r}") from error
        self._arrays, self.is_in_use = state["arrays"], True
        return run

    def save(self, run: EmState, identity: Mapping[str, Any], stages: StageTimer) -> None:
        """Writes a checkpoint, which replaces the one before.

        Raises:
            InputError: it cannot be written, e.g. the disk is full; the checkpoint before remains.
        """
        before, number = self.newest, len(run.records)
        work, final = self.folder / "new.part", self.folder / f"iteration-{number}"
        try:
            self._clear(work)
            work.mkdir()
            values, arrays = pack_state(run)
            about = {name: self._put(work, before, name, a) for name, a in arrays.items()}
            state = {"identity": dict(identity), "arrays": about, "state": values}
            _write_state(work / _STATE, {**state, "stages": stages.to_dict()})
            sync(work)
            os.rename(work, final)
            sync(self.folder)
        except BaseException as error:
            self._clear(work)
            if not isinstance(error, OSError):
                raise
            what = f"no checkpoint can be written: {error.strerror or error}"
            raise InputError(what, where=str(self.folder)) from error
        self._arrays, self.is_in_use = about, True
        self._clear(
            *(path for path in self.folder.iterdir() if path.name not in (_LOCK, final.name))
        )

    def _put(
        self, work: Path, before: Path | None, name: str, array: NDArray[Any]
    ) -> dict[str, Any]:
        """Writes an array, unless the checkpoint before has it; its checksum, shape and dtype."""
        if before is not None and name in self._arrays and name.startswith("e-"):
            os.link(before / f"{name}.npy", work / f"{name}.npy")
            return self._arrays[name]
        write_npy(work / f"{name}.npy", array)
        sync(work / f"{name}.npy")
        return {"crc32": _checksum(array), "shape": array.shape, "dtype": array.dtype.str}

    def clear(self) -> None:
        """Removes what earlier runs left."""
        self._clear(*(path for path in self.folder.iterdir() if path.name != _LOCK))

    def recover(self, output: Path) -> None:
        """Removes the leftovers of a killed run; puts back a result that it had moved aside."""
        for path in list(self.folder.iterdir()):
            if path.name.endswith(".old") and not output.exists():
                os.rename(path, output)
            elif path.name.endswith((".part", ".old")):
                self._clear(path)

    @defer_signals
    def _clear(self, *paths: Path) -> None:
        for path in paths:
            if path.is_dir() and not path.is_symlink():
                if not path.name.endswith(".part"):
                    # an interruption in the middle must not leave half a checkpoint
                    path = path.rename(self.folder / f"{path.name}.gone.part")
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)


@contextmanager
@defer_signals
def lock_checkpoints(output: Path) -> Iterator[CheckpointFolder]:
    """The checkpoint folder of a result folder, locked against other runs while the block runs.

    It is removed when it holds no checkpoint.

    Raises:
        InputError: another run holds the lock, or the folder cannot be made.
    """
    given, output = output, resolve_output(output)
    folder = hidden_path(output, "resume")
    made = [path for path in (*reversed(output.parents),) if not path.exists()]
    try:
        file = _open_lock(folder, given)
    except OSError as error:
        raise cannot_write(error, given) from error
    checkpoints = CheckpointFolder(folder)
    try:
        finish_exchange(output)
        checkpoints.recover(output)
        yield checkpoints
    finally:
        if checkpoints.newest is None:
            shutil.rmtree(folder, ignore_errors=True)
            for path in reversed(made):
                with suppress(OSError):
                    path.rmdir()
        file.close()


def _open_lock(folder: Path, output: Path) -> IO[bytes]:
    """The open lock file, which the kernel unlocks when this process ends."""
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        try:
            file = open_lock(folder / _LOCK)
        except FileNotFoundError:  # the run that had it has just ended
            continue
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            file.close()
            raise InputError(
                "another run is writing there", where=str(output), hint="wait for it, or stop it"
            ) from error
        except OSError:
            pass  # a file system without locks
        if _is_there(folder / _LOCK, file):
            return file
        file.close()


def _is_there(path: Path, file: IO[bytes]) -> bool:
    """True if an open file still has its name."""
    try:
        return os.path.samestat(path.stat(), os.fstat(file.fileno()))
    except OSError:
        return False


def _write_state(path: Path, state: Mapping[str, Any]) -> None:
    text = json.dumps({"format_version": _FORMAT_VERSION, **state})
    whole = {"crc32": zlib.crc32(text.encode()), "text": text}
    path.write_text(json.dumps(whole), encoding="utf-8")
    sync(path)


def _state(path: Path) -> dict[str, Any]:
    try:
        whole = read_json(path, _LARGEST_STATE)
        text = whole["text"]
        if zlib.crc32(text.encode()) != whole["crc32"]:
            raise DamagedCheckpoint(f"{path}: its checksum differs")
        state: dict[str, Any] = json.loads(text)
    except InputError as error:
        raise DamagedCheckpoint(str(error)) from error
    except (ValueError, KeyError, TypeError, RecursionError, AttributeError) as error:
        raise DamagedCheckpoint(f"{path}: {error!r}") from error
    if not isinstance(state, dict) or state.get("format_version") != _FORMAT_VERSION:
        version = state.get("format_version") if isinstance(state, dict) else None
        raise DamagedCheckpoint(f"{path}: format_version {version!r} is unknown here")
    return state


def _array(path: Path, about: Mapping[str, Any]) -> NDArray[Any]:
    if not _NAME.fullmatch(path.name):
        raise DamagedCheckpoint(f"{path}: no name of an array")
    try:
        found = open_npy(path)
    except InputError as error:
        raise DamagedCheckpoint(str(error)) from error
    if list(found.shape) != about["shape"] or found.dtype.str != about["dtype"]:
        raise DamagedCheckpoint(f"{path}: not the array that was written")
    if _checksum(found) != about["crc32"]:
        raise DamagedCheckpoint(f"{path}: its checksum differs")
    return np.array(found) if found.nbytes < _IN_MEMORY else found


def _checksum(array: NDArray[Any]) -> int:
    found = 0
    for part in iter_bytes(array):
        found = zlib.crc32(part, found)
    return found
