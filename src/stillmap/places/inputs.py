"""Sessions on their way into a place: each is mapped, and what the place keeps of it is written."""

import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np

from stillmap.core.array_folder import write_arrays
from stillmap.core.errors import InputError
from stillmap.core.json import write_json
from stillmap.core.parallel import resolve_threads
from stillmap.core.profiling import Progress, prefix_steps
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.io.registry import detect_format
from stillmap.pipeline.options import Options
from stillmap.places.evidence import find_beam_cells
from stillmap.places.keyframes import Session, chain_poses, select_keyframes
from stillmap.places.objects import copy_objects
from stillmap.places.store import SESSION_ORIGIN, STATE, read_session, write_session
from stillmap.results.folder import open_result
from stillmap.results.mapped_place import input_stem
from stillmap.results.near_result import NearResult
from stillmap.results.reader import LOCAL_ORIGIN, RECORD, TILTING, is_place, is_result, read_run
from stillmap.results.result import Result, build, load
from stillmap.slam import deskew_recording

Given: TypeAlias = Sequence[str | os.PathLike[str]] | Recording | Result

_VOXEL_SIZE = 0.15  # m, of the evidence of 3D sessions, unless the options say another


@dataclass(frozen=True, eq=False)
class SessionInput(ShortRepr):
    """One session to be merged.

    Attributes:
        name: unique in its place.
        given: paths of its recording, several where it was recorded in parts, or of one result; or
            the recording or the result itself.
    """

    name: str
    given: tuple[Path, ...] | Recording | Result

    @property
    def path(self) -> str | None:
        """Its path, of several parts the first; None: it has none."""
        if isinstance(self.given, Result):
            return None if self.given.path is None else str(self.given.path)
        return None if isinstance(self.given, Recording) else str(self.given[0])


@dataclass(frozen=True, eq=False)
class MergeJob(ShortRepr):
    """Sessions to be merged, and the settings.

    Attributes:
        base: folder of a place to which sessions are added; None: a new place.
        sessions: to be merged, in the order in which they were given.
        options: of mapping, and of the map.
        frame: name of the session whose frame the place has; None: the first one, or as it was.
        map_state: "last", "majority", the name of a session, or a date (ISO 8601).
        odometry: whether odometry in recordings is used.
    """

    base: Path | None
    sessions: list[SessionInput]
    options: Options
    frame: str | None = None
    map_state: str = "last"
    odometry: bool = True


def list_sessions(groups: Sequence[Given], taken: Sequence[str] = ()) -> list[SessionInput]:
    """The sessions of inputs, each a group of paths that belong together.

    Args:
        groups: of recordings, or single result folders; or recordings and results themselves.
        taken: names that are in use.

    Raises:
        InputError: something is not there, or neither a recording nor a result.
    """
    out, names = list[SessionInput](), set(taken)
    for group in groups:
        given = group
        if not isinstance(given, Recording | Result):
            given = tuple(Path(path) for path in given)
            _check_paths(given)
        names.add(name := _unique(_find_stem(given), names))
        out.append(SessionInput(name, given))
    return out


def _check_paths(paths: tuple[Path, ...]) -> None:
    for path in paths:
        if is_place(path):
            hint = "a place to which sessions are added is the first of all"
            raise InputError("is a place, among sessions", where=str(path), hint=hint)
        if not is_result(path):
            detect_format(path)  # refuses what nobody can read, before any work
    if _is_one_result(paths):
        _require_recording(paths[0])


def _is_one_result(given: tuple[Path, ...]) -> bool:
    return len(given) == 1 and is_result(given[0])


def _require_recording(result: Path) -> None:
    """Refuse a result whose recording cannot be read again.

    Raises:
        InputError: it has gone, or is of a rig.
    """
    if (result / TILTING).is_dir():
        raise InputError("is a rig with a tilting laser, which is not merged", where=str(result))
    try:
        open_result(result).require_source()
    except InputError as error:
        hint = f"{result} was made from it: merge the recording itself from where it is now"
        raise InputError(error.what, where=error.where, hint=hint) from error


def _find_stem(given: tuple[Path, ...] | Recording | Result) -> str:
    """The stem of a result's folder or of where a recording was read from, else `session`."""
    if isinstance(given, tuple):
        return input_stem(given[0])
    if isinstance(given, Result):
        if given.path is not None:
            return input_stem(given.path)
        given = given.recording
    return input_stem(Path(given.source.path)) if given.source.path else "session"


def _unique(stem: str, names: set[str]) -> str:
    if stem not in names:
        return stem
    return next(name for k in range(2, len(names) + 3) if (name := f"{stem}-{k}") not in names)


def prepare_sessions(job: MergeJob, folder: Path, progress: Progress) -> list[Session]:
    """The sessions, each mapped where it was not, with what the place keeps of it written.

    Args:
        job: what is to be merged.
        folder: of the place; `sessions/NAME` are made.
        progress: as of `merge_sessions`.

    Raises:
        InputError: an input cannot be read or mapped.
    """
    out = []
    for number, session in enumerate(job.sessions, start=1):
        report = prefix_steps(progress, f"session {number}")
        out.append(_prepare_session(session, job, folder, report))
    return out


def _prepare_session(
    session: SessionInput, job: MergeJob, folder: Path, report: Progress
) -> Session:
    given, options = session.given, job.options
    if isinstance(given, tuple) and _is_one_result(given):
        given = load(given[0])
    if isinstance(given, Result) and given.path is not None:
        return keep_session(session, given, given.deskewed, folder, options)
    with tempfile.TemporaryDirectory(prefix=".mapped-", dir=folder) as scratch:
        if not isinstance(given, Result):
            given = build(given, options, odometry=job.odometry, progress=report, scratch=scratch)
        mapped, recording = Path(scratch) / "result", given.recording
        given.save(mapped)
        del given
        result = load(mapped)
        deskewed = deskew_recording(recording, result.poses, result.options.slam)
        return keep_session(session, result, deskewed, folder, options)


def keep_session(
    source: SessionInput, result: Result, deskewed: Recording, folder: Path, options: Options
) -> Session:
    """Write what the place keeps of a mapped session, and open it again from there.

    Args:
        source: the session.
        result: of its T scans, opened.
        deskewed: its recording without the motion during its scans.
        folder: of the place.
        options: of mapping, and of the map.
    """
    assert result.path is not None
    near, p_static = NearResult.find(result.path, result.poses), np.asarray(result.p_static)
    poses = near.take(result.poses)
    graph = near.read_graph() or chain_poses(poses)
    keyframes = select_keyframes(deskewed, poses, p_static, graph.keyframes)
    cell = cell_size(options, deskewed.dimension)
    beams = find_beam_cells(deskewed, poses, p_static, graph, cell)
    home = folder / "sessions" / source.name
    (home / "beams").mkdir(parents=True)
    record = {**read_run(result.path), "dimension": deskewed.dimension}
    record.pop(LOCAL_ORIGIN, None)  # what is written of a session is in the frame of its place
    if near.origin.any():
        record[SESSION_ORIGIN] = near.origin.tolist()
    write_json(home / RECORD, record, indent=2)
    offset = np.asarray(deskewed.offset, np.int64)
    of_beams = {"stamp_ns": np.asarray(result.stamp_ns), "offset": offset, "hit": result.hit}
    write_arrays(home / "beams", of_beams)
    write_session(home, poses, graph, keyframes, beams)
    copy_objects(result.path, home / STATE)
    return read_session(home, source.path, resolve_threads(options.threads))


def cell_size(options: Options, dimension: int) -> float:
    """m, edge of a cell of the evidence."""
    if dimension == 2:
        return options.slam.resolution
    return options.slam.voxel_size or _VOXEL_SIZE
