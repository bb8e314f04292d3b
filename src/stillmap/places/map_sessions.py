"""Sessions on their way into a place: each is mapped, and what the place keeps of it written."""

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from stillmap.core.arrays import write_npy
from stillmap.core.parallel import resolve_threads
from stillmap.core.profiling import Progress
from stillmap.core.recording import Recording
from stillmap.pipeline.options import Options
from stillmap.places.beam_cells import find_beam_cells
from stillmap.places.inputs import SessionInput, copy_record, load_mapped
from stillmap.places.objects import copy_objects
from stillmap.places.prepare import make_session
from stillmap.places.session import Session
from stillmap.places.store import STATE, read_session, write_session
from stillmap.results.build import build
from stillmap.results.result import BuiltResult
from stillmap.results.saved import SavedResult

_VOXEL_SIZE = 0.15  # m, of the evidence of 3D sessions, unless the options say another


def prepare_sessions(
    inputs: Sequence[SessionInput],
    options: Options,
    odometry: bool,
    folder: Path,
    progress: Progress,
) -> list[Session]:
    """The sessions, each mapped where it was not, with what the place keeps of it written.

    Args:
        inputs: to be merged.
        options: of mapping, and of the map.
        odometry: whether odometry in recordings is used.
        folder: of the place; `sessions/NAME` are made.
        progress: as of `merge_sessions`.

    Raises:
        InputError: an input cannot be read or mapped.
    """
    out = []
    for number, one in enumerate(inputs, start=1):

        def report(stage: str, iteration: int, done: int, total: int, number: int = number) -> None:
            progress(f"session {number}: {stage}", iteration, done, total)

        out.append(_prepare_session(one, options, odometry, folder, report))
    return out


def _prepare_session(
    one: SessionInput, options: Options, odometry: bool, folder: Path, report: Progress
) -> Session:
    if one.is_result:
        return _keep_session(one, one.parts[0], folder, options)
    if isinstance(one.given, SavedResult):
        return _keep_session(one, one.given.path, folder, options, one.given.recording)
    with tempfile.TemporaryDirectory(prefix=".mapped-", dir=folder) as scratch:
        result = _map_session(one, options, odometry, scratch, report)
        mapped = Path(scratch) / "result"
        result.save(mapped)
        recording = result.recording
        del result
        return _keep_session(one, mapped, folder, options, recording)


def _map_session(
    one: SessionInput, options: Options, odometry: bool, scratch: str, report: Progress
) -> BuiltResult:
    if isinstance(one.given, BuiltResult):
        return one.given
    parts: str | list[str] = [str(path) for path in one.parts]
    if len(parts) == 1:
        parts = parts[0]
    return build(
        one.given if isinstance(one.given, Recording) else parts,
        options,
        odometry=odometry,
        progress=report,
        scratch=scratch,
    )


def _keep_session(
    one: SessionInput,
    mapped: Path,
    folder: Path,
    options: Options,
    recording: Recording | None = None,
) -> Session:
    """Write what the place keeps of a mapped session, and open it again from there.

    Args:
        one: the session.
        mapped: its result.
        folder: of the place.
        options: of mapping, and of the map.
        recording: as it was mapped; None: read again.
    """
    found, result = load_mapped(one.name, mapped, resolve_threads(options.threads), recording)
    session = make_session(found)
    cell = cell_size(options, session.dimension)
    beams = find_beam_cells(found.deskewed, found.poses, found.p_static, session.graph, cell)
    home = folder / "sessions" / one.name
    home.mkdir()
    copy_record(mapped, home, session)
    (home / "beams").mkdir()
    for array in ("stamp_ns", "offset", "hit"):
        write_npy(home / "beams" / f"{array}.npy", np.asarray(getattr(result.labels, array)))
    write_session(home, session, beams)
    copy_objects(mapped, home / STATE)
    return read_session(home, one.path, np.array(session.stamp_ns))


def cell_size(options: Options, dimension: int) -> float:
    """m, edge of a cell of the evidence."""
    if dimension == 2:
        return options.slam.resolution
    return options.slam.voxel_size or _VOXEL_SIZE
