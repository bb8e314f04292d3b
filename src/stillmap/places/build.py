"""`stillmap.merge`: sessions of one place merged, called from Python."""

# signatures name the types of sessions instead of spelling them out
from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from stillmap.core.errors import InputError
from stillmap.core.files import new_folder
from stillmap.core.profiling import Progress
from stillmap.core.recording import Recording
from stillmap.pipeline.options import Options
from stillmap.places.inputs import is_place, list_sessions
from stillmap.places.merge import MergeJob, merge_sessions
from stillmap.places.reader import read_sessions
from stillmap.places.saved_place import SavedPlace, load_place, remove_with
from stillmap.results.build import report_to, to_options
from stillmap.results.result import BuiltResult
from stillmap.results.saved import SavedResult

Paths: TypeAlias = Sequence[str | os.PathLike[str]]
SessionLike: TypeAlias = str | os.PathLike[str] | Paths | Recording | BuiltResult | SavedResult


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
) -> SavedPlace:
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
    chosen, (base, others) = to_options(options), _split_base(sessions)
    taken = [] if base is None else [record["name"] for record in read_sessions(base)]
    job = MergeJob(base, list_sessions(others, taken), chosen, frame, map_state, odometry)
    with report_to(progress, chosen.em.max_iterations) as tell:
        if output is not None:
            _require_apart(Path(output), job)
            merge_sessions(job, Path(output), overwrite, tell)
            return load_place(Path(output))
        return _merge_temporarily(job, tell)


def _split_base(
    sessions: Sequence[SessionLike],
) -> tuple[Path | None, list[Paths | Recording | BuiltResult | SavedResult]]:
    """The place that grows, if there is one, and the sessions."""
    given = [[one] if isinstance(one, str | os.PathLike) else one for one in sessions]
    first = given[0] if given else None
    if isinstance(first, SavedPlace):
        return first.path, given[1:]
    if isinstance(first, list) and len(first) == 1 and is_place(Path(first[0])):
        return Path(first[0]), given[1:]
    return None, given


def _require_apart(output: Path, job: MergeJob) -> None:
    """Refuse an output that is an input, or holds one.

    Raises:
        InputError: it does.
    """
    inputs = [path for one in job.sessions for path in one.parts]
    for path in inputs if job.base is None else [job.base, *inputs]:
        if output.resolve() in (path.resolve(), *path.resolve().parents):
            raise InputError("is one of the sessions, or holds one", where=str(output))


def _merge_temporarily(job: MergeJob, tell: Progress) -> SavedPlace:
    with new_folder("stillmap-place-") as home:
        merge_sessions(job, home / "place", progress=tell)
        place = load_place(home / "place")
        remove_with(place, home)
    return place
