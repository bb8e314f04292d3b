"""Scores of the poses of sessions that `stillmap merge` put into one frame."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import scipy  # its parts load when they are first used
from numpy.typing import NDArray
from place_truth import SessionTruth

from stillmap.core import json as json_files
from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.results.eval.labels import Scores
from stillmap.results.eval.readers import read_trajectory
from stillmap.results.eval.trajectory import align, associate_trajectories

Float = NDArray[np.float64]
Verdict = Literal["right", "coarse", "wrong", "refused", "refused rightly"]

RIGHT = (0.05, 0.5)  # m, degrees: at most, of a session that is placed rightly
WRONG = (0.5, 5.0)  # m, degrees: more is a wrong place
_SEAM = 5.0  # m between poses of two sessions that are compared
_MAX_BYTES = 64 << 20  # of a JSON file of a place
FRAME_DT = 1e-3  # s: a place carries the stamps of its recordings


@dataclass(frozen=True, eq=False)
class PlacedSession:
    """A session as `sessions.json` of a place has it, with its poses and the true ones.

    Attributes:
        name: in the place.
        number: of the same session in the truth.
        accepted: whether it was placed.
        why: why not.
        T_place_session: (D+1, D+1); None where it was not accepted.
        poses, true_poses: (N, D+1, D+1) in the frame of the place and in the world; empty where it
            was not accepted.
    """

    name: str
    number: int
    accepted: bool
    why: str
    T_place_session: Float | None
    poses: Float
    true_poses: Float


@dataclass(frozen=True)
class PoseScores(Scores):
    """Errors of a session; NaN where it was not placed, or in another place than the first one.

    The frame of the place is laid on the world by the best rigid alignment of all poses of the
    first accepted session.

    Attributes:
        name: of the session.
        verdict: "right": at most 5 cm and 0.5 degrees; "wrong": more than 0.5 m or 5 degrees, or
            placed though it was recorded elsewhere; "coarse": between; "refused"; "refused
            rightly": it was recorded elsewhere.
        overlap: the largest share of its hits in what one of the others saw, in truth.
        translation, rotation: m, degrees, by which the rigid alignment of its own poses differs
            from that of the first accepted session, in the middle of its path.
        start_translation, start_rotation: m, degrees; errors of `T_place_session`.
        mean_distance, max_distance: m, between its estimated and true positions.
        median_seam, max_seam: m, errors of displacements between each of its poses and the nearest
            one of another accepted session, where that is truly within 5 m: how well the sessions
            fit together, however the whole is bent.
    """

    name: str
    verdict: Verdict
    overlap: float
    translation: float
    rotation: float
    start_translation: float
    start_rotation: float
    mean_distance: float
    max_distance: float
    median_seam: float
    max_seam: float


def read_json(path: Path) -> Any:
    """A JSON file of a place.

    Raises:
        InputError: it is missing, too large or damaged.
    """
    if not path.is_file():
        hint = "a folder that 'stillmap merge' wrote"
        raise InputError("does not exist", where=str(path), hint=hint)
    return json_files.read_json(path, _MAX_BYTES)


def read_sessions(place: Path, truth: SessionTruth) -> list[PlacedSession]:
    """The sessions of a place, in its order.

    Raises:
        InputError: a file is missing or damaged, or a session is not in the truth.
    """
    path = place / "sessions.json"
    tree = read_json(path)
    try:
        return [_read_session(place, one, truth) for one in tree]
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise InputError(f"is damaged: {error!r}", where=str(path)) from error


def _read_session(place: Path, one: dict[str, Any], truth: SessionTruth) -> PlacedSession:
    name, accepted = str(one["name"]), bool(one["accepted"])
    if Path(name).name != name:
        raise ValueError(f"'{name}' is no name")
    number = _find_session(name, str(one.get("input", "")), truth)
    n = truth.dimension + 1
    if not accepted:
        empty = np.empty((0, n, n))
        return PlacedSession(name, number, False, str(one.get("why", "")), None, empty, empty)
    T_place_session = np.array(one["T_place_session"], np.float64)
    if T_place_session.shape != (n, n):
        raise ValueError(f"T_place_session of '{name}' is {T_place_session.shape}")
    estimated = read_trajectory(place / "sessions" / name / "trajectory.tum")
    true = read_trajectory(truth.folder / truth.names[number] / "truth/trajectory.tum")
    i, j = associate_trajectories(estimated.stamp_s, true.stamp_s, FRAME_DT)
    keep = [0, 1, 3] if n == 3 else [0, 1, 2, 3]
    both = [T[..., keep, :][..., keep] for T in (estimated.poses[i], true.poses[j])]
    return PlacedSession(name, number, True, "", T_place_session, *both)


def _find_session(name: str, source: str, truth: SessionTruth) -> int:
    """The number of a session in the truth, by its name or the name of its input.

    Raises:
        InputError: there is none.
    """
    for one in (name, Path(source).name, Path(source).stem):
        if one in truth.names:
            return truth.names.index(one)
    hint = "inputs are recognised by their folders' names, as in sessions.json of the truth"
    raise InputError(f"session '{name}' is not in {truth.folder}", hint=hint)


def align_place(sessions: list[PlacedSession], truth: SessionTruth) -> tuple[Float, int]:
    """T_world_place by the first accepted session, and the number of its true place.

    Raises:
        InputError: none was accepted.
    """
    for one in sessions:
        if one.accepted:
            return align(one.poses, one.true_poses), int(truth.place[one.number])
    raise InputError("the place has no accepted session")


def score_poses(sessions: list[PlacedSession], truth: SessionTruth) -> list[PoseScores]:
    """The errors of each session.

    Raises:
        InputError: none was accepted.
    """
    T_world_place, home = align_place(sessions, truth)
    at_home = [one for one in sessions if one.accepted and truth.place[one.number] == home]
    scores = []
    for one in sessions:
        others = [other for other in at_home if other is not one]
        scores.append(_score(one, others, truth, T_world_place, home))
    return scores


def _score(
    one: PlacedSession,
    at_home: list[PlacedSession],
    truth: SessionTruth,
    T_world_place: Float,
    home: int,
) -> PoseScores:
    k, nan = one.number, float("nan")
    others = np.delete(truth.overlap[:, k], k)
    overlap = float(others.max()) if len(others) else nan
    elsewhere = truth.place[k] != home
    if one.T_place_session is None or elsewhere:
        verdict: Verdict = "refused rightly" if elsewhere else "refused"
        return PoseScores(one.name, "wrong" if one.accepted else verdict, overlap, *[nan] * 8)
    D = truth.dimension
    off = np.linalg.norm((T_world_place @ one.poses - one.true_poses)[:, :D, D], axis=1)
    start = np.linalg.inv(truth.T_world_session[k]) @ T_world_place @ one.T_place_session
    own = align(one.poses, one.true_poses)
    middle = one.poses[:, :D, D].mean(axis=0)
    apart = (own - T_world_place)[:D, :D] @ middle + (own - T_world_place)[:D, D]
    turn = np.linalg.inv(own) @ T_world_place
    translation, rotation = float(np.linalg.norm(apart)), _degrees(turn)
    if translation <= RIGHT[0] and rotation <= RIGHT[1]:
        verdict = "right"
    else:
        verdict = "wrong" if translation > WRONG[0] or rotation > WRONG[1] else "coarse"
    return PoseScores(
        one.name,
        verdict,
        overlap,
        translation,
        rotation,
        float(np.linalg.norm(start[:D, D])),
        _degrees(start),
        float(off.mean()),
        float(off.max()),
        *_measure_seam(one, at_home),
    )


def _measure_seam(one: PlacedSession, others: list[PlacedSession]) -> tuple[float, float]:
    """Median and largest error, m, of displacements to the nearest poses of other sessions."""
    if not others:
        return float("nan"), float("nan")
    poses = np.concatenate([other.poses for other in others])
    true_poses = np.concatenate([other.true_poses for other in others])
    D = poses.shape[-1] - 1
    tree = scipy.spatial.cKDTree(true_poses[:, :D, D])
    away, nearest = tree.query(one.true_poses[:, :D, D], distance_upper_bound=_SEAM)
    near = np.flatnonzero(np.isfinite(away))
    if not len(near):
        return float("nan"), float("nan")
    there = np.asarray(nearest)[near]
    found = np.linalg.inv(poses[there]) @ one.poses[near]
    true = np.linalg.inv(true_poses[there]) @ one.true_poses[near]
    error = np.linalg.norm((found - true)[:, :D, D], axis=1)
    return float(np.median(error)), float(error.max())


def _degrees(T: Float) -> float:
    """The angle of a rotation."""
    if len(T) == 3:
        return float(np.degrees(abs(se2.parameters(T)[2])))
    R = T[:3, :3]
    skew = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return float(np.degrees(np.arctan2(np.linalg.norm(skew) / 2, (np.trace(R) - 1) / 2)))
