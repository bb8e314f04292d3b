"""Checkpoints for `--resume`: the state of EM after the last finished iteration of a run.

It lies in `.NAME.resume/iteration-K/` beside the output NAME, with the key of the run: version,
options, and a hash of its input. The folder is locked while the run lasts.
"""

import hashlib
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import msgpack
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap import em
from stillmap.core.array_folder import open_npy, read_record, write_arrays
from stillmap.core.array_types import Float
from stillmap.core.arrays import iter_bytes
from stillmap.core.config import iter_options
from stillmap.core.errors import InputError, explaining_refusal
from stillmap.core.files import hidden_path, package_version, remove, resolve_output
from stillmap.core.input_files import hold_lock
from stillmap.core.interrupts import defer_signals
from stillmap.core.json import to_jsonable
from stillmap.core.profiling import StageTimer
from stillmap.core.recording import Recording
from stillmap.pipeline.em_loop import EmState
from stillmap.pipeline.options import Options

_RECORD, _LOCK = "checkpoint.json", "lock"
_NO_MATTER = ("threads", "output.region")  # options on which no iteration depends
_INLINE = 64  # numbers: larger arrays have a file of their own
_FILE, _ARRAY, _GRID = 1, 2, 3  # MessagePack's codes of what stands for arrays and grids


class CheckpointFolder:
    """The checkpoints of one run; see `lock_checkpoints`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.is_in_use = False  # the newest checkpoint is of this run

    @property
    def newest(self) -> Path | None:
        """The last complete checkpoint; None where there is none."""
        folders = self.folder.glob("iteration-[0-9]*")
        complete = [one for one in folders if one.name.removeprefix("iteration-").isdecimal()]
        return max(complete, key=lambda one: int(one.name.removeprefix("iteration-")), default=None)

    def load(self, key: dict[str, Any], options: Options, stages: StageTimer) -> EmState | None:
        """The state of the run at its last checkpoint; None: there is none.

        Args:
            key: of the run, see `identify_run`.
            options: of the run, resolved.
            stages: the time that the run took so far is added here.

        Raises:
            InputError: it is damaged, or of another recording or other options.
        """
        folder = self.newest
        if folder is None:
            return None
        path = folder / _RECORD
        record = read_record(path)
        try:
            _require_same_run(record["key"], key, str(self.folder))
            packed, *arrays = (open_npy(folder / f"{k}.npy") for k in range(record["arrays"]))
            if record["digest"] != _digest(packed, *arrays):
                raise ValueError("not what was written")
            unpack = partial(_unpack, arrays)
            state = msgpack.decode(packed.data, type=EmState, ext_hook=unpack)
            state.options = options
            stages.add(record["stages"])
        except InputError:
            raise
        except Exception as error:  # what no run has written fails in many ways
            what = f"is damaged: {error!r}".replace("\n", " ")
            raise InputError(what, where=str(path)) from error
        self.is_in_use = True
        return state

    def save(self, state: EmState, key: dict[str, Any], stages: StageTimer) -> None:
        """Write a checkpoint, which replaces the one before.

        Raises:
            InputError: it cannot be written, e.g. the disk is full; the one before remains.
        """
        before = self.newest
        work, final = self.folder / "new.part", self.folder / f"iteration-{len(state.records)}"
        large = dict[int, NDArray[Any]]()
        packed = msgpack.encode(state, enc_hook=partial(_pack, large))
        arrays = [np.frombuffer(packed, np.uint8), *large.values()]
        record = {"key": key, "arrays": len(arrays), "stages": stages.to_dict()}
        record["digest"] = _digest(*arrays)
        try:
            remove(work)
            work.mkdir()
            files = {str(number): array for number, array in enumerate(arrays)}
            write_arrays(work, files, _RECORD, record)
            remove(final)
            os.rename(work, final)
        except OSError as error:
            remove(work)
            what = f"no checkpoint can be written: {error.strerror or error}"
            raise InputError(what, where=str(self.folder)) from error
        self.is_in_use = True
        if before not in (None, final):
            remove(before)

    def clear(self) -> None:
        """Remove what earlier runs left."""
        for path in self.folder.iterdir():
            if path.name != _LOCK:
                remove(path)


@contextmanager
@defer_signals
def lock_checkpoints(output: Path) -> Iterator[CheckpointFolder]:
    """The checkpoint folder of a result folder, locked against other runs while the block runs.

    It is removed when it holds no checkpoint.

    Raises:
        InputError: another run holds the lock, or the folder cannot be made.
    """
    given, output = output, resolve_output(output)
    checkpoints = CheckpointFolder(hidden_path(output, "resume"))
    made = [path for path in output.parents if not path.exists()]
    with explaining_refusal(given):
        what = "another run is writing there"
        file = hold_lock(checkpoints.folder / _LOCK, what, str(given))
    try:
        yield checkpoints
    finally:
        if checkpoints.newest is None:
            shutil.rmtree(checkpoints.folder, ignore_errors=True)
            with suppress(OSError):
                for path in made:
                    path.rmdir()
        file.close()


def _pack(large: dict[int, NDArray[Any]], value: Any) -> Any:
    """Encodes an array, a number of NumPy or an empty grid; large arrays go into `large`."""
    if isinstance(value, em.Grid):  # always empty here
        dimension = 2 if isinstance(value, _core.OccupancyGrid2D) else 3
        return msgpack.Ext(_GRID, msgpack.encode([dimension, value.resolution]))
    if not isinstance(value, np.ndarray):
        return value.item()  # NumPy's numbers
    if value.size <= _INLINE:
        content = [value.dtype.str, value.shape, value.tobytes()]
        return msgpack.Ext(_ARRAY, msgpack.encode(content))
    large.setdefault(id(value), value)
    return msgpack.Ext(_FILE, msgpack.encode([*large].index(id(value))))


def _unpack(large: list[NDArray[Any]], code: int, packed: memoryview) -> Any:
    """Decodes what `_pack` encoded."""
    content = msgpack.decode(packed)
    if code == _FILE:
        return large[content]
    if code == _GRID:
        return em.make_grid(*content)
    dtype, shape, values = content
    # refuses objects, which would be addresses in memory
    return np.frombuffer(bytearray(values), dtype).reshape(shape)


def identify_run(recording: Recording, options: Options, poses: Float | None) -> dict[str, Any]:
    """The key of a run: its version, options, and a hash of the arrays of its input."""
    names = ("stamp_ns", "offset", "points", "hit", "beam_time", "T_base_sensor", "sensor")
    arrays = (*(getattr(recording, name) for name in names), recording.T_odom_base, poses)
    values = {one.name: to_jsonable(one.value) for one in iter_options(options)}
    matter = {name: value for name, value in values.items() if name not in _NO_MATTER}
    return {"version": package_version(), **matter, "input": _digest(*arrays)}


def _digest(*arrays: NDArray[Any] | None) -> str:
    """Of the types, shapes and values of arrays."""
    digest = hashlib.blake2b(digest_size=16)
    for array in arrays:
        digest.update(b"none" if array is None else f"{array.dtype.str} {array.shape}".encode())
        for part in () if array is None else iter_bytes(array):
            digest.update(part)
    return digest.hexdigest()


def _require_same_run(before: dict[str, Any], now: dict[str, Any], where: str) -> None:
    """Refuse to go on with the run of something else.

    Raises:
        InputError: it names what differs.
    """
    names = sorted(name for name in {*before, *now} if before.get(name) != now.get(name))
    differ = [f"{name} was {before.get(name)!r}, is {now.get(name)!r}" for name in names]
    if "input" in names:
        differ[names.index("input")] = "another recording, odometry or poses"
    if differ:
        hint = "give the same as before, or start anew without resume=True"
        raise InputError(f"cannot be resumed: {'; '.join(differ)}", where=where, hint=hint)
