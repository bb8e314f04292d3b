"""What `--resume` goes on from: poses and P(static) of the last finished iteration of a run.

They lie in `.NAME.resume/iteration-K/` beside the output NAME, with the key of the run: version,
options, and a hash of its input. The folder is locked while the run lasts.
"""

import dataclasses
import fcntl
import hashlib
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from stillmap import em, slam
from stillmap.core.array_folder import read_model, read_poses, read_probabilities, write_arrays
from stillmap.core.arrays import iter_bytes
from stillmap.core.config import iter_options
from stillmap.core.errors import InputError, cannot_write
from stillmap.core.files import hidden_path, package_version, remove, resolve_output
from stillmap.core.input_files import open_lock
from stillmap.core.interrupts import defer_signals
from stillmap.core.json import to_jsonable
from stillmap.core.profiling import StageTimer
from stillmap.core.recording import Recording
from stillmap.io.rigid_transforms import MAX_TRANSLATION
from stillmap.pipeline.estimate import EmState, Estimate, IterationRecord
from stillmap.pipeline.options import Options

_RECORD, _LOCK = "checkpoint.json", "lock"
_NO_MATTER = ("threads", "output.region")  # options on which no iteration depends


@dataclasses.dataclass(frozen=True)
class _Record:
    """`checkpoint.json`."""

    key: dict[str, Any]
    iterations: list[IterationRecord]
    stages: dict[str, dict[str, float]]


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

    def load(
        self, key: dict[str, Any], options: Options, recording: Recording, stages: StageTimer
    ) -> EmState | None:
        """The state from which the run goes on; None: there is none.

        At least one iteration is left to be done. Of earlier ones their numbers are known.

        Args:
            key: of the run, see `identify_run`.
            options: of the run, resolved.
            recording: T scans with M beams.
            stages: the time that the run took so far is added here.

        Raises:
            InputError: it is damaged, or of another recording or other options.
        """
        folder = self.newest
        if folder is None:
            return None
        record = read_model(folder / _RECORD, _Record)
        _require_same_run(record.key, key, str(self.folder))
        D, T, M = recording.dimension, recording.n_scans, recording.n_beams
        poses = read_poses(folder / "poses.npy", T, D, MAX_TRANSLATION)
        p_static = read_probabilities(folder / "p_static.npy", M)
        records = record.iterations[: em.max_iterations(options.estimator, options.em) - 1]
        if not records:
            return None
        stages.add(record.stages)
        dof = 3 * (D - 1)
        m_step = slam.MStepResult(
            poses,
            np.full((T, dof, dof), np.nan),
            em.make_grid(D, options.slam.resolution),
            np.full(T, np.nan),
        )
        likelihood = em.Likelihood(records[-1].expected_log_likelihood, records[-1].bound)
        e_step = em.EStepResult(p_static, likelihood)
        self.is_in_use = True
        return EmState(options, records, latest=Estimate(len(records), p_static, m_step, e_step))

    def save(self, state: EmState, key: dict[str, Any], stages: StageTimer) -> None:
        """Write a checkpoint, which replaces the one before.

        Raises:
            InputError: it cannot be written, e.g. the disk is full; the one before remains.
        """
        before, latest = self.newest, state.latest
        assert latest is not None
        work, final = self.folder / "new.part", self.folder / f"iteration-{len(state.records)}"
        record = _Record(key, state.records, stages.to_dict())
        try:
            remove(work)
            work.mkdir()
            arrays: dict[str, NDArray[Any]] = {"poses": latest.poses, "p_static": latest.p_static}
            write_arrays(work, arrays, _RECORD, dataclasses.asdict(record))
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
    try:
        file = _lock(checkpoints.folder, given)
    except OSError as error:
        raise cannot_write(error, given) from error
    try:
        yield checkpoints
    finally:
        if checkpoints.newest is None:
            shutil.rmtree(checkpoints.folder, ignore_errors=True)
            with suppress(OSError):
                for path in made:
                    path.rmdir()
        file.close()


def _lock(folder: Path, output: Path) -> IO[bytes]:
    """The open lock file, which the kernel unlocks when this process ends."""
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):  # the run that had it has just ended
            file = open_lock(folder / _LOCK)
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                file.close()
                what, hint = "another run is writing there", "wait for it, or stop it"
                raise InputError(what, where=str(output), hint=hint) from error
            except OSError:
                pass  # a file system without locks
            if os.path.samestat(os.stat(folder / _LOCK), os.fstat(file.fileno())):
                return file
            file.close()


def identify_run(
    recording: Recording, options: Options, poses: NDArray[np.float64] | None
) -> dict[str, Any]:
    """The key of a run: its version, options, and a hash of the arrays of its input."""
    found = hashlib.blake2b(digest_size=16)
    names = ("stamp_ns", "offset", "points", "hit", "beam_time", "T_base_sensor", "sensor")
    for array in (*(getattr(recording, name) for name in names), recording.T_odom_base, poses):
        found.update(b"none" if array is None else f"{array.dtype.str} {array.shape}".encode())
        for part in () if array is None else iter_bytes(array):
            found.update(part)
    options_now = {
        one.name: to_jsonable(one.value)
        for one in iter_options(options)
        if one.name not in _NO_MATTER
    }
    return {"version": package_version(), **options_now, "input": found.hexdigest()}


def _require_same_run(before: dict[str, Any], now: dict[str, Any], where: str) -> None:
    """Refuse to go on with the run of something else.

    Raises:
        InputError: it names what differs.
    """
    names = sorted(name for name in {*before, *now} if before.get(name) != now.get(name))
    if not names:
        return
    differ = [
        "another recording, odometry or poses"
        if name == "input"
        else f"{name} was {before.get(name)!r}, is {now.get(name)!r}"
        for name in names
    ]
    hint = "give the same as before, or start anew without resume=True"
    raise InputError(f"cannot be resumed: {'; '.join(differ)}", where=where, hint=hint)
