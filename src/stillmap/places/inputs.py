"""The inputs of a merge: recordings, result folders, or a place."""

import dataclasses
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np

from stillmap.core.errors import InputError
from stillmap.core.json import write_json
from stillmap.core.local_frame import LocalFrame
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.io.registry import detect_format
from stillmap.places.prepare import MappedRecording
from stillmap.places.session import Session
from stillmap.results.folder import open_result
from stillmap.results.pose_graph_g2o import read_g2o
from stillmap.results.reader import SESSIONS as SESSIONS  # of places, found there as well
from stillmap.results.result import BuiltResult
from stillmap.results.run_json import LOCAL_ORIGIN, RECORD, TILTING
from stillmap.results.run_record import is_result, read_record
from stillmap.results.saved import SavedResult, load
from stillmap.slam import deskew_recording

TIES = "ties.npz"  # constraints between the sessions of a place
# in the record of a session: of the frame that a place has it in, in the map frame of its result
SESSION_ORIGIN = "session_origin"
MAX_DISTANCE = 1e6  # m, of poses from the origin of their session: no place is larger

Given: TypeAlias = Sequence[str | os.PathLike[str]] | Recording | BuiltResult | SavedResult


@dataclass(frozen=True, eq=False)
class SessionInput(ShortRepr):
    """One session to be merged.

    Attributes:
        name: unique in its place.
        parts: paths of its recording, several where it was recorded in parts; or of one result.
        is_result: whether `parts` is a result folder.
        given: the recording or the result itself, without a path; None: read from `parts`.
    """

    name: str
    parts: tuple[Path, ...] = ()
    is_result: bool = False
    given: Recording | BuiltResult | SavedResult | None = None

    @property
    def path(self) -> str | None:
        """Its path, of several parts the first; None: it has none."""
        if isinstance(self.given, SavedResult):
            return str(self.given.path)
        return str(self.parts[0]) if self.parts else None


def is_place(path: Path) -> bool:
    """True if a folder is a place, also one from which a file was taken."""
    return (path / "sessions").is_dir() and any((path / one).is_file() for one in (SESSIONS, TIES))


def list_sessions(
    groups: Sequence[Given],
    taken: Sequence[str] = (),
) -> list[SessionInput]:
    """The sessions of inputs, each a group of paths that belong together.

    Args:
        groups: of recordings, or single result folders; or recordings and results themselves.
        taken: names that are in use.

    Raises:
        InputError: something is not there, or neither a recording nor a result.
    """
    out, names = list[SessionInput](), set(taken)
    for group in groups:
        if isinstance(group, Recording | BuiltResult | SavedResult):
            one = SessionInput(_unique(_name_given(group), names), given=group)
        else:
            one = _find_session(tuple(Path(path) for path in group), names)
        names.add(one.name)
        out.append(one)
    return out


def _find_session(paths: tuple[Path, ...], names: set[str]) -> SessionInput:
    for path in paths:
        if is_place(path):
            hint = "a place to which sessions are added is the first of all"
            raise InputError("is a place, among sessions", where=str(path), hint=hint)
        if not is_result(path):
            detect_format(path)  # refuses what nobody can read, before any work
    mapped = len(paths) == 1 and is_result(paths[0])
    if mapped:
        _require_recording(paths[0])
    return SessionInput(_unique(_stem(paths[0]), names), paths, mapped)


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


def _name_given(given: Recording | BuiltResult | SavedResult) -> str:
    """The stem of a result's folder or of where a recording was read from, else `session`."""
    if isinstance(given, SavedResult):
        return _stem(given.path)
    recording = given if isinstance(given, Recording) else given.recording
    path = recording.source.get("path")
    return _stem(Path(path)) if isinstance(path, str) and path else "session"


def _stem(path: Path) -> str:
    """The name of an input without endings."""
    name = Path(os.path.abspath(path)).name
    stem = name.split(".")[0] or name
    return stem.replace("/", "_")


def _unique(stem: str, names: set[str]) -> str:
    if stem not in names:
        return stem
    return next(name for k in range(2, len(names) + 3) if (name := f"{stem}-{k}") not in names)


def load_mapped(
    name: str, folder: Path, threads: int, recording: Recording | None = None
) -> tuple[MappedRecording, SavedResult]:
    """A result folder as a session, in the frame near the robot in which it was computed.

    Args:
        name: of the session.
        folder: the result.
        threads: number of threads.
        recording: as it was mapped; None: read again.

    Raises:
        InputError: a file is missing or damaged, or the recording is not there any more.
    """
    result = load(folder)
    graph = folder / "graph.g2o"
    output = result.options.output
    if recording is None:
        deskewed = result.deskewed
    else:
        deskewed = deskew_recording(recording, result.poses, result.folder.slam_options)
    frame, pose_graph = result.folder.frame, read_g2o(graph) if graph.is_file() else None
    if not frame.is_shifted:  # a session of a place does not say
        frame = LocalFrame.near(result.poses)
    poses = frame.to_local(result.poses)
    if not (np.abs(poses) < MAX_DISTANCE).all():
        raise InputError("local_origin is far from its trajectory", where=str(folder / RECORD))
    if pose_graph is not None:
        pose_graph = dataclasses.replace(pose_graph, poses=frame.to_local(pose_graph.poses))
    mapped = MappedRecording(
        name,
        deskewed,
        poses,
        np.asarray(result.p_static),
        pose_graph,
        (output.min_obstacle_height, output.max_obstacle_height),
        threads,
        frame,
    )
    return mapped, result


def copy_record(result: Path, folder: Path, session: Session) -> None:
    """Copy what describes how a session was read and mapped."""
    record = {**read_record(result), "dimension": session.dimension}
    record.pop(LOCAL_ORIGIN, None)  # what is written of a session is in the frame of its place
    if session.frame.is_shifted:
        record[SESSION_ORIGIN] = session.frame.origin.tolist()
    write_json(folder / RECORD, record, indent=2)
