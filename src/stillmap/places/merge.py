"""Merge sessions to a place: map each, add one after the other, then write what all of them say."""

# signatures name the types of sessions instead of spelling them out
from __future__ import annotations

import os
import shutil
import tempfile
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.core.files import atomic_folder, remove
from stillmap.core.parallel import limit_blas_threads, resolve_threads
from stillmap.core.profiling import Progress, no_progress, prefix_steps
from stillmap.core.recording import Recording
from stillmap.pipeline.options import Options, adopt_cells
from stillmap.places.finish import PlaceResult, finish_place, require_map_state, write_place
from stillmap.places.grow import add_session, start_place
from stillmap.places.inputs import MergeJob, cell_size, list_sessions, prepare_sessions
from stillmap.places.keyframes import Session
from stillmap.places.place import Place, update_evidence
from stillmap.places.store import copy_session, read_place
from stillmap.results.reader import RECORD, is_place
from stillmap.results.result import Result, load, report_to, to_options
from stillmap.results.timeline import PlaceSession, read_sessions

Paths: TypeAlias = Sequence[str | os.PathLike[str]]
SessionLike: TypeAlias = str | os.PathLike[str] | Paths | Recording | Result


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
    _require_apart(output, job)
    with atomic_folder(output, RECORD, overwrite) as folder:
        (folder / "sessions").mkdir()
        place, refusals, order = _open_base(job, folder, threads)
        if place is not None:
            edges = {"resolution": place.resolution}
            if place.dimension == 3:
                edges["voxel_size"] = place.voxel_size
            options = adopt_cells(job.options, "place", edges)
            job = replace(job, frame=job.frame or place.frame, options=options)
        _check_job(job, [*order, *(session.name for session in job.sessions)])
        sessions = prepare_sessions(job, folder, progress)
        order += [session.name for session in sessions]
        place, refused = _grow(place, sessions, job, threads, progress)
        refusals += refused
        if len(place.sessions) < 2:
            reasons = "; ".join(f"{refusal.name}: {refusal.why}" for refusal in refusals)
            what = f"fewer than two sessions could be placed: {reasons}"
            raise InputError(what, hint="add a session whose route overlaps both")
        if job.frame is not None:
            place = update_evidence(_reframe(place, job.frame), threads)
        for refusal in refused:
            shutil.rmtree(folder / "sessions" / refusal.name)
        progress("merging", 0, 0, 0)
        result = finish_place(place, refusals, order, job.map_state)
        write_place(folder, result, job.options, job.map_state)
    return result


def _open_base(
    job: MergeJob, folder: Path, threads: int
) -> tuple[Place | None, list[PlaceSession], list[str]]:
    """The place to which sessions are added, what it keeps copied; nothing for a new place."""
    if job.base is None:
        return None, [], []
    place, refusals, order = read_place(job.base, threads)
    for placed in place.sessions:
        name = placed.session.name
        copy_session(job.base / "sessions" / name, folder / "sessions" / name)
    return update_evidence(place, threads), refusals, order


def _grow(
    place: Place | None,
    sessions: Sequence[Session],
    job: MergeJob,
    threads: int,
    progress: Progress,
) -> tuple[Place, list[PlaceSession]]:
    """The place with all sessions that could be placed, and the others.

    A new place starts with the first session; if no other one fits it, with the next.
    """
    if place is not None:
        return _add_all(place, sessions, threads, progress)
    best: tuple[Place, list[PlaceSession]] | None = None
    for number, seed in enumerate(sessions):
        cell = cell_size(job.options, seed.dimension)
        start = start_place(seed, job.options.slam.resolution, cell, threads)
        others = [session for session in sessions if session is not seed]
        grown = _add_all(start, others, threads, progress)
        if best is None or len(grown[0].sessions) > len(best[0].sessions):
            best = grown
        # what is left cannot be more than what was found
        if len(best[0].sessions) >= len(sessions) - number - 1:
            break
    if best is None:
        raise InputError("no session is named")
    return best


def _add_all(
    place: Place, sessions: Sequence[Session], threads: int, progress: Progress
) -> tuple[Place, list[PlaceSession]]:
    """Adds sessions in their order; those that do not fit are tried again after others did."""
    pending, refusals, grew = list(sessions), dict[str, PlaceSession](), True
    while pending and grew:
        grew = False
        for session in list(pending):
            why = ""
            if session.dimension != place.dimension:
                why = f"it is in {session.dimension}D, the place in {place.dimension}D"
            else:
                report = prefix_steps(progress, session.name)
                place, why = add_session(place, session, threads, report)
            if why:
                refusals[session.name] = PlaceSession(session.name, session.input, False, why)
            else:
                pending.remove(session)
                refusals.pop(session.name, None)
                grew = True
    return place, [refusals[session.name] for session in pending]


def _reframe(place: Place, name: str) -> Place:
    """The place in the frame of one of its sessions.

    Raises:
        InputError: it is not in the place.
    """
    for placed in place.sessions:
        if placed.session.name == name:
            back = se2.inverse(placed.T)
            moved = place.with_nodes([back @ moving.nodes for moving in place.sessions])
            return replace(moved, frame=name)
    raise _no_frame(name, [placed.session.name for placed in place.sessions])


def _check_job(job: MergeJob, names: Sequence[str]) -> None:
    """Refuse, before any work, one session alone, and a frame or a state of the map of none.

    Raises:
        InputError: it is such a job.
    """
    if len(names) < 2:
        raise InputError("one session alone is no place", hint="merge it with others, or map it")
    if job.frame is not None and job.frame not in names:
        raise _no_frame(job.frame, names)
    require_map_state(job.map_state, names)


def _no_frame(name: str, known: Sequence[str]) -> InputError:
    hint = f"frame=NAME wants one of {', '.join(known)}"
    return InputError(f"cannot have the frame of {name}: no such session in the place", hint=hint)


def merge(
    sessions: Sequence[SessionLike],
    *,
    options: Options | Mapping[str, Any] | None = None,
    frame: str | None = None,
    map_state: str = "last",
    odometry: bool = True,
    output: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    progress: bool | Progress = False,
) -> Result:
    """Merge sessions of one place into one map with dated changes.

    A session that cannot be placed for certain is left out; `sessions` of the place has the reason.

    Args:
        sessions: each the path of a recording, the paths of its parts, the folder of a result, or a
            recording or result itself. The first may be a place that is to grow, or its folder.
        options: as of `stillmap.build`, for what is mapped, and for the map.
        frame: name of the session whose frame the place has; None: the first one, or as it was.
        map_state: what changed is shown as it was in the "last" session, in the "majority" of them,
            in the one of this name, or at a date (ISO 8601).
        odometry: whether odometry in recordings is used.
        output: folder of the place; None: a temporary one, which goes with the returned object.
        overwrite: replace an earlier place in `output`.
        progress: as of `stillmap.build`.

    Raises:
        InputError: an input cannot be read, the output cannot be written, or fewer than two
            sessions could be placed.

    Examples:
        >>> place = stillmap.merge(["monday", "tuesday"])
        >>> place.save("place")
    """
    if isinstance(sessions, str | os.PathLike):
        raise TypeError("sessions: expected a list of sessions, got one path")
    job = plan_merge(sessions, to_options(options), frame, map_state, odometry)
    with report_to(progress, job.options.em.max_iterations) as report:
        if output is not None:
            merge_sessions(job, Path(output), overwrite, report)
            return load(Path(output))
        return _merge_temporarily(job, report)


def plan_merge(
    sessions: Sequence[SessionLike],
    options: Options,
    frame: str | None,
    map_state: str,
    odometry: bool,
) -> MergeJob:
    """The job of `merge`.

    Raises:
        InputError: no session is named, or one cannot be read.
    """
    others = [[one] if isinstance(one, str | os.PathLike) else one for one in sessions]
    first, base = others[0] if others else None, None
    if isinstance(first, Result) and first.path is not None and len(first.sessions) > 1:
        base = first.path
    elif isinstance(first, list) and len(first) == 1 and is_place(Path(first[0])):
        base = Path(first[0])
    others = others if base is None else others[1:]
    if not others:
        where = "" if base is None else str(base)
        raise InputError("no session is named that is to be merged", where=where)
    taken = [] if base is None else [known.name for known in read_sessions(base)]
    return MergeJob(base, list_sessions(others, taken), options, frame, map_state, odometry)


def _require_apart(output: Path, job: MergeJob) -> None:
    """Refuse an output that is an input, or holds one.

    Raises:
        InputError: it does.
    """
    groups = [session.given for session in job.sessions]
    inputs = [path for group in groups if isinstance(group, tuple) for path in group]
    for path in inputs if job.base is None else [job.base, *inputs]:
        if output.resolve() in (path.resolve(), *path.resolve().parents):
            raise InputError("is one of the sessions, or holds one", where=str(output))


def _merge_temporarily(job: MergeJob, report: Progress) -> Result:
    home = Path(tempfile.mkdtemp(prefix="stillmap-place-"))
    try:
        merge_sessions(job, home / "place", progress=report)
        place = load(home / "place")
    except BaseException:
        remove(home)
        raise
    weakref.finalize(place, remove, home)  # when it is no longer used
    return place
