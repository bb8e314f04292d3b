"""Merge sessions to a place: map each, add one after the other, then write what all of them say."""

import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stillmap.core import se2
from stillmap.core.arrays import write_npy
from stillmap.core.errors import InputError
from stillmap.core.files import atomic_folder
from stillmap.core.parallel import limit_blas_threads, resolve_threads
from stillmap.core.profiling import Progress, no_progress
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.pipeline.options import Options
from stillmap.places.beam_cells import find_beam_cells
from stillmap.places.finish import finish_place, require_map_state, write_place
from stillmap.places.grow import add_session, start_place
from stillmap.places.inputs import SessionInput, copy_record, load_mapped
from stillmap.places.objects import copy_objects
from stillmap.places.place import Place, Refusal, update_evidence
from stillmap.places.prepare import make_session
from stillmap.places.reader import read_place
from stillmap.places.session import Session
from stillmap.places.store import STATE, read_session, write_session
from stillmap.places.writer import PlaceResult
from stillmap.results.build import build
from stillmap.results.result import BuiltResult
from stillmap.results.run_json import RECORD

_VOXEL_SIZE = 0.15  # m, of the evidence of 3D sessions, unless the options say another


@dataclass(frozen=True, eq=False)
class MergeJob(ShortRepr):
    """What is merged, and how.

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


@limit_blas_threads()
def merge_sessions(
    job: MergeJob, output: Path, overwrite: bool = False, progress: Progress = no_progress
) -> PlaceResult:
    """Merge sessions and write the folder of the place, complete or not at all.

    A session that cannot be placed, or could be in several places, is left out and named with the
    reason; it does not change the map.

    Args:
        job: see MergeJob.
        output: the folder; must not exist or be empty unless `overwrite`.
        overwrite: replace an earlier place.
        progress: called with the step, the session's number, and work done and in all.

    Raises:
        InputError: an input cannot be read, the output cannot be written, or fewer than two
            sessions could be placed.
    """
    threads = resolve_threads(job.options.threads)
    with atomic_folder(output, RECORD, overwrite) as folder:
        (folder / "sessions").mkdir()
        place, refusals, order = _open_base(job, folder)
        _check_choices(job, [*order, *(one.name for one in job.sessions)])
        sessions = _prepare_sessions(job, folder, progress)
        order += [one.name for one in sessions]
        place, refused = _grow(place, sessions, job, threads, progress)
        refusals += refused
        if len(place.sessions) < 2:
            raise InputError(_describe_failure(refusals), hint="map them one by one")
        if job.frame is not None:
            place = update_evidence(_reframe(place, job.frame), threads)
        for one in refused:
            shutil.rmtree(folder / "sessions" / one.name)
        progress("merging", 0, 0, 0)
        result = finish_place(place, refusals, order, job.map_state)
        write_place(folder, result, job.options, job.map_state)
    return result


def _open_base(job: MergeJob, folder: Path) -> tuple[Place | None, list[Refusal], list[str]]:
    """The place to which sessions are added, its state copied; nothing for a new place."""
    if job.base is None:
        return None, [], []
    place, refusals, order = read_place(job.base)
    for one in place.sessions:
        name = one.session.name
        shutil.copytree(job.base / "sessions" / name, folder / "sessions" / name)
    return place, refusals, order


def _prepare_sessions(job: MergeJob, folder: Path, progress: Progress) -> list[Session]:
    """The sessions, each mapped where it was not, with what the place keeps of it written."""
    out = []
    for number, one in enumerate(job.sessions, start=1):

        def report(stage: str, iteration: int, done: int, total: int, number: int = number) -> None:
            progress(f"session {number}: {stage}", iteration, done, total)

        home = folder / "sessions" / one.name
        if one.is_result:
            out.append(_keep_session(one.name, one.parts[0], home, job.options))
            continue
        with tempfile.TemporaryDirectory(prefix=".mapped-", dir=folder) as scratch:
            result, mapped = _map_session(one, job, scratch, report), Path(scratch) / "result"
            result.save(mapped)
            recording = result.recording
            del result
            out.append(_keep_session(one.name, mapped, home, job.options, recording))
    return out


def _map_session(one: SessionInput, job: MergeJob, scratch: str, report: Progress) -> BuiltResult:
    if isinstance(one.given, BuiltResult):
        return one.given
    parts = [str(path) for path in one.parts]
    source = parts[0] if len(parts) == 1 else parts
    return build(
        source if one.given is None else one.given,
        job.options,
        odometry=job.odometry,
        progress=report,
        scratch=scratch,
    )


def _keep_session(
    name: str, folder: Path, home: Path, options: Options, recording: Recording | None = None
) -> Session:
    """Write what the place keeps of a mapped session, and open it again from there.

    Args:
        name: of the session.
        folder: its result.
        home: `sessions/NAME` of the place; it is made.
        options: of mapping, and of the map.
        recording: as it was mapped; None: read again.
    """
    mapped, result = load_mapped(name, folder, resolve_threads(options.threads), recording)
    session = make_session(mapped)
    cell = _cell_size(options, session.dimension)
    beams = find_beam_cells(mapped.deskewed, mapped.poses, mapped.p_static, session.graph, cell)
    home.mkdir()
    copy_record(folder, home, session.dimension)
    (home / "beams").mkdir()
    for array in ("stamp_ns", "offset", "hit"):
        write_npy(home / "beams" / f"{array}.npy", np.asarray(getattr(result.labels, array)))
    write_session(home, session, beams)
    copy_objects(folder, home / STATE)
    return read_session(home, session.source, np.array(session.stamp_ns))


def _cell_size(options: Options, dimension: int) -> float:
    """m, edge of a cell of the evidence."""
    if dimension == 2:
        return options.slam.resolution
    return options.slam.voxel_size or _VOXEL_SIZE


def _grow(
    place: Place | None,
    sessions: Sequence[Session],
    job: MergeJob,
    threads: int,
    progress: Progress,
) -> tuple[Place, list[Refusal]]:
    """The place with all sessions that could be placed, and the others.

    A new place starts with the first session; if no other one fits it, with the next.
    """
    if place is not None:
        return _add_all(place, sessions, threads, progress)
    seeds = sorted(sessions, key=lambda one: one.name != job.frame)  # the frame's session first
    best: tuple[Place, list[Refusal]] | None = None
    for number, seed in enumerate(seeds):
        cell = _cell_size(job.options, seed.dimension)
        start = start_place(seed, job.options.slam.resolution, cell, threads)
        others = [one for one in sessions if one is not seed]
        found = _add_all(start, others, threads, progress)
        if best is None or len(found[0].sessions) > len(best[0].sessions):
            best = found
        # what is left cannot be more than what was found
        if len(best[0].sessions) >= len(seeds) - number - 1 or job.frame is not None:
            break
    if best is None:
        raise InputError("no session is named")
    return best


def _add_all(
    place: Place, sessions: Sequence[Session], threads: int, progress: Progress
) -> tuple[Place, list[Refusal]]:
    """Adds sessions in their order; those that do not fit are tried again after others did."""
    pending, refusals, grew = list(sessions), dict[str, Refusal](), True
    while pending and grew:
        grew = False
        for session in list(pending):
            why = ""
            if session.dimension != place.dimension:
                why = f"it is in {session.dimension}D, the place in {place.dimension}D"
            else:
                growth = add_session(place, session, threads, _step(progress, session))
                place, why = growth.place, growth.refused
            if why:
                refusals[session.name] = Refusal(session.name, session.source, why)
            else:
                pending.remove(session)
                refusals.pop(session.name, None)
                grew = True
    return place, [refusals[one.name] for one in pending]


def _step(progress: Progress, session: Session) -> Callable[[str], None]:
    return lambda step: progress(f"{session.name}: {step}", 0, 0, 0)


def _reframe(place: Place, name: str) -> Place:
    """The place in the frame of one of its sessions.

    Raises:
        InputError: it is not in the place.
    """
    for one in place.sessions:
        if one.session.name == name:
            back = se2.inverse(one.T)
            return place.with_nodes([back @ other.nodes for other in place.sessions])
    raise _no_frame(name, [one.session.name for one in place.sessions])


def _check_choices(job: MergeJob, names: Sequence[str]) -> None:
    """Refuse a frame or a state of the map of no session, before any work.

    Raises:
        InputError: it is such a one.
    """
    if job.frame is not None and job.frame not in names:
        raise _no_frame(job.frame, names)
    require_map_state(job.map_state, names)


def _no_frame(name: str, known: Sequence[str]) -> InputError:
    hint = f"frame=NAME wants one of {', '.join(known)}"
    return InputError(f"cannot have the frame of {name}: no such session in the place", hint=hint)


def _describe_failure(refusals: Sequence[Refusal]) -> str:
    reasons = "; ".join(f"{one.name}: {one.why}" for one in refusals)
    return f"fewer than two sessions could be placed: {reasons}"
