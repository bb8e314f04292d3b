"""Sessions on their way into a place: each is mapped, and what the place keeps of it is written."""

import dataclasses
import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeAlias

import numpy as np

from stillmap import em
from stillmap.core import se2
from stillmap.core.array_folder import write_arrays
from stillmap.core.array_types import Float, Float32
from stillmap.core.errors import InputError
from stillmap.core.json import write_json
from stillmap.core.parallel import resolve_threads
from stillmap.core.profiling import Progress
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.io.registry import detect_format
from stillmap.mapping.projection import project_to_plane
from stillmap.pipeline.options import Options
from stillmap.places.evidence import find_beam_cells
from stillmap.places.keyframes import Keyframes, Session, select_keyframes
from stillmap.places.objects import copy_objects
from stillmap.places.store import SESSION_ORIGIN, STATE, read_session, write_session
from stillmap.results.folder import open_result
from stillmap.results.mapped_place import input_stem
from stillmap.results.near_result import NearResult
from stillmap.results.reader import LOCAL_ORIGIN, RECORD, TILTING, is_place, is_result, read_run
from stillmap.results.result import Result, build, load
from stillmap.slam import PoseGraph, deskew_recording, local_map
from stillmap.slam.local_map import KEYFRAME_ANGLE
from stillmap.slam.pose_graph import Constraint

Given: TypeAlias = Sequence[str | os.PathLike[str]] | Recording | Result

_VOXEL_SIZE = 0.15  # m, of the evidence of 3D sessions, unless the options say another
_NODE_DISTANCE = {2: 1.0, 3: 2.0}  # m between the nodes of a session without a pose graph
# of a step between them: m and rad, at least, and per root of a metre
_STEP_STD, _MIN_STEP = (0.01, 0.002), 0.05
_PLANAR_CELL = 0.1  # m, in which one planar hit per direction is kept


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
    given: Recording | Result | None = None

    @property
    def path(self) -> str | None:
        """Its path, of several parts the first; None: it has none."""
        if isinstance(self.given, Result):
            return None if self.given.path is None else str(self.given.path)
        return str(self.parts[0]) if self.parts else None


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
        if isinstance(group, Recording | Result):
            session = SessionInput(_unique(_name_given(group), names), given=group)
        else:
            session = _find_session(tuple(Path(path) for path in group), names)
        names.add(session.name)
        out.append(session)
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
    return SessionInput(_unique(input_stem(paths[0]), names), paths, mapped)


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


def _name_given(given: Recording | Result) -> str:
    """The stem of a result's folder or of where a recording was read from, else `session`."""
    if isinstance(given, Result) and given.path is not None:
        return input_stem(given.path)
    recording = given if isinstance(given, Recording) else given.recording
    path = recording.source.path
    return input_stem(Path(path)) if path else "session"


def _unique(stem: str, names: set[str]) -> str:
    if stem not in names:
        return stem
    return next(name for k in range(2, len(names) + 3) if (name := f"{stem}-{k}") not in names)


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
    return [
        _prepare_session(session, options, odometry, folder, partial(_report, progress, number))
        for number, session in enumerate(inputs, start=1)
    ]


def _report(
    progress: Progress, number: int, stage: str, iteration: int, done: int, total: int
) -> None:
    progress(f"session {number}: {stage}", iteration, done, total)


def _prepare_session(
    session: SessionInput, options: Options, odometry: bool, folder: Path, report: Progress
) -> Session:
    given = session.given
    if session.is_result:
        return _keep_session(session, session.parts[0], folder, options)
    if isinstance(given, Result) and given.path is not None:
        return _keep_session(session, given.path, folder, options, given.recording)
    with tempfile.TemporaryDirectory(prefix=".mapped-", dir=folder) as scratch:
        if isinstance(given, Result):
            result = given
        else:
            paths = [str(path) for path in session.parts]
            result = build(
                given or (paths[0] if len(paths) == 1 else paths),
                options,
                odometry=odometry,
                progress=report,
                scratch=scratch,
            )
        mapped = Path(scratch) / "result"
        result.save(mapped)
        recording = result.recording
        del result
        return _keep_session(session, mapped, folder, options, recording)


def _keep_session(
    source: SessionInput,
    mapped: Path,
    folder: Path,
    options: Options,
    recording: Recording | None = None,
) -> Session:
    """Write what the place keeps of a mapped session, and open it again from there.

    Args:
        source: the session.
        mapped: its result.
        folder: of the place.
        options: of mapping, and of the map.
        recording: as it was mapped; None: read again.
    """
    result = load(mapped)
    if recording is None:
        deskewed = result.deskewed
    else:
        deskewed = deskew_recording(recording, result.poses, result.options.slam)
    session = to_session(source.name, result, deskewed, resolve_threads(options.threads))
    cell, p_static = cell_size(options, session.dimension), np.asarray(result.p_static)
    beams = find_beam_cells(deskewed, session.poses, p_static, session.graph, cell)
    home = folder / "sessions" / source.name
    home.mkdir()
    _copy_record(mapped, home, session)
    (home / "beams").mkdir()
    offset = np.asarray(deskewed.offset, np.int64)
    arrays = {"stamp_ns": np.asarray(result.stamp_ns), "offset": offset, "hit": result.hit}
    write_arrays(home / "beams", arrays)
    write_session(home, session, beams)
    copy_objects(mapped, home / STATE)
    return read_session(home, source.path, np.array(session.stamp_ns))


def to_session(name: str, result: Result, deskewed: Recording, threads: int) -> Session:
    """A result that was loaded as a session, in the frame near the robot in which it was computed.

    Args:
        name: of the session.
        result: T scans with M beams.
        deskewed: its recording without the motion during its scans.
        threads: number of threads.

    Raises:
        InputError: its record or pose graph is damaged.
    """
    assert result.path is not None
    near, output = NearResult.find(result.path, result.poses), result.options.output
    poses, graph = near.take(result.poses), near.read_graph()
    band = (output.min_obstacle_height, output.max_obstacle_height)
    p_static = np.asarray(result.p_static)
    session = make_session(name, deskewed, poses, p_static, graph, band, threads)
    return dataclasses.replace(session, origin=near.origin)


def make_session(
    name: str,
    deskewed: Recording,
    poses: Float,
    p_static: Float32,
    graph: PoseGraph | None,
    band: tuple[float, float],
    threads: int = 1,
) -> Session:
    """The session of a mapped recording.

    Args:
        name: unique in its place.
        deskewed: T scans with M beams, without the motion during its scans.
        poses: (T, D+1, D+1) T_map_base.
        p_static: (M,) P(static).
        graph: the pose graph; None: there is none.
        band: m above the ground, lowest and greatest height of obstacles.
        threads: number of threads.
    """
    graph = graph or chain_poses(poses)
    keyframes = select_keyframes(deskewed, poses, p_static, graph.keyframes)
    planar, clearance = keyframes, np.zeros(len(keyframes))
    if keyframes.dimension == 3:
        planar, clearance = _project(keyframes, band, threads)
    return Session(name, None, deskewed.stamp_ns, poses, graph, keyframes, planar, clearance)


def chain_poses(poses: Float) -> PoseGraph:
    """A pose graph of poses (T, D+1, D+1) that no graph came with: steps between keyframes."""
    D = poses.shape[-1] - 1
    nodes = local_map.select_keyframes(poses, _NODE_DISTANCE[D], KEYFRAME_ANGLE)
    steps = se2.inverse(poses[nodes[:-1]]) @ poses[nodes[1:]]
    metres = np.linalg.norm(steps[:, :D, D], axis=1) + _MIN_STEP
    turns = D * (D - 1) // 2
    unit = np.diag(np.square([_STEP_STD[0]] * D + [_STEP_STD[1]] * turns))
    chain = [
        Constraint(k, k + 1, T, length * unit)
        for k, (T, length) in enumerate(zip(steps, metres.tolist(), strict=True))
    ]
    return PoseGraph(nodes, poses[nodes], chain)


def _project(
    keyframes: Keyframes, band: tuple[float, float], threads: int
) -> tuple[Keyframes, Float]:
    """Keyframes of a 3D session in the plane, and the clearance (K,) of each above the ground."""
    recording, poses = keyframes.recording, keyframes.poses
    ground = em.estimate_ground(recording, poses, keyframes.e, threads)
    plan = project_to_plane(recording, poses, ground, band, _PLANAR_CELL, False, threads)
    e = keyframes.e[plan.beam]
    planar = Keyframes(plan.recording, keyframes.scans, plan.poses, e, keyframes.nodes)
    xy = np.ascontiguousarray(poses[:, :2, 3])
    return planar, poses[:, 2, 3] - ground.height_at(xy)


def _copy_record(result: Path, folder: Path, session: Session) -> None:
    """Copy what describes how a session was read and mapped."""
    record = {**read_run(result), "dimension": session.dimension}
    record.pop(LOCAL_ORIGIN, None)  # what is written of a session is in the frame of its place
    if session.origin.any():
        record[SESSION_ORIGIN] = session.origin.tolist()
    write_json(folder / RECORD, record, indent=2)


def cell_size(options: Options, dimension: int) -> float:
    """m, edge of a cell of the evidence."""
    if dimension == 2:
        return options.slam.resolution
    return options.slam.voxel_size or _VOXEL_SIZE
