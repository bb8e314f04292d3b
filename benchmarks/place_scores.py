"""Scores of a place that `stillmap merge` made of simulated sessions: poses, changes, labels, maps.

python benchmarks/place_scores.py PLACE DAYS [--single RESULT ...]

DAYS is a folder that `stillmap simulate --sessions` wrote.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from common import make_parser
from numpy.typing import NDArray
from place_cells import MIN_BEAMS, CellTruth, collect_cells, widen
from place_changes import ChangeScores, read_changes, read_named_cells, score_changes
from place_poses import (
    FRAME_DT,
    PlacedSession,
    PoseScores,
    align_place,
    read_sessions,
    score_poses,
)
from place_truth import SessionTruth, load_session_truth
from place_voxels import VoxelTruth, collect_voxels

from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.core.json import to_jsonable
from stillmap.results.eval.labels import LabelScores, Scores, score_labels
from stillmap.results.eval.map import GHOST_DISTANCE, distance_to_walls, is_near_occupied
from stillmap.results.eval.readers import read_trajectory
from stillmap.results.eval.trajectory import align, associate_trajectories, planar
from stillmap.results.reader import Grid, moved, read_grid, read_labels, require_there

Bool = NDArray[np.bool_]
Float = NDArray[np.float64]


@dataclass(frozen=True)
class PlaceLabelScores(Scores):
    """Scores of the labels of all sessions of a place that shows its last state.

    Truly dynamic are movers, and what a later session saw gone: at least MIN_BEAMS of its beams
    passed there.

    Attributes:
        beams: of all hits; positive is dynamic.
        gone: hits on what is gone.
        gone_found: share of these that are called dynamic.
        stays_kept: share of the hits on what stands there in all sessions that are called static.
    """

    beams: LabelScores
    gone: int
    gone_found: float
    stays_kept: float


def score_place_labels(
    place: Path, sessions: list[PlacedSession], truth: SessionTruth, cells: VoxelTruth
) -> PlaceLabelScores:
    """Score the labels of a place.

    Args:
        place: the folder.
        sessions: the accepted ones, by date.
        truth: of all sessions.
        cells: the truth about the voxels of these sessions.

    Raises:
        InputError: a file is missing, damaged, or of another recording.
    """
    columns = []
    for k, one in enumerate(sessions):
        labels = read_labels(place / "sessions" / one.name)
        beams, changed = truth.beams(one.number), truth.changed_beams(one.number)
        if len(labels.p_static) != len(beams.static):
            what = f"has {len(labels.p_static)} beams, the truth {len(beams.static)}"
            raise InputError(what, where=str(place / "sessions" / one.name))
        gone = _find_gone(k, changed, beams.T_world_base, cells)
        stays = beams.static & (changed < 0)
        columns.append((labels.p_static, beams.static & ~gone, labels.hit, gone, stays))
    p, static, hit, gone, stays = (np.concatenate(column) for column in zip(*columns, strict=True))
    labelled = hit & ~np.isnan(p)
    gone, stays = gone & labelled, stays & labelled
    return PlaceLabelScores(
        score_labels(p, static, hit),
        int(gone.sum()),
        _share(p[gone] < 0.5),
        _share(p[stays] >= 0.5),
    )


def _find_gone(
    session: int, changed: NDArray[np.int32], poses: NDArray[np.float64], cells: VoxelTruth
) -> Bool:
    """(M,) the beams of a session on what stood there and a later session saw gone.

    session: index among those of `cells`. changed: (M,) index of the object, or -1.
    """
    beams = np.flatnonzero(changed >= 0)
    at = cells.voxels.find(cells.recordings[session].end_points(beams, poses))
    gone = np.zeros(len(cells.fixed), bool)
    for k in range(session + 1, len(cells.seen)):
        gone |= cells.seen[k].passes >= MIN_BEAMS
        gone &= ~cells.surfaces[k]
    out = np.zeros(len(changed), bool)
    out[beams] = gone[at] & (at >= 0)
    return out


def _share(of: Bool) -> float:
    return float(of.mean()) if len(of) else float("nan")


@dataclass(frozen=True)
class SessionMapScores(Scores):
    """NaN where a denominator is zero.

    Attributes:
        name: of the folder.
        occupied_cells: of the map.
        ghost_cells: those more than two cells from every surface of the last session.
        ghosts_per_100_m2: these per 100 m2 of free area.
        avoidable_ghosts: those of them that are not within two cells of an object that stood there
            when a session last looked: since then fewer than MIN_BEAMS beams of each passed.
        wall_cells: cells of 5 cm of surfaces that are the same in all sessions, in which
            MIN_BEAMS beams of the map's sessions ended.
        walls_kept: share of these whose cell in the map, or one of its 8 neighbours, is occupied.
    """

    name: str
    occupied_cells: int
    ghost_cells: int
    ghosts_per_100_m2: float
    avoidable_ghosts: int
    wall_cells: int
    walls_kept: float


def score_place_map(
    name: str,
    grid: Grid,
    T_world_map: Float,
    truth: SessionTruth,
    cells: CellTruth,
    sessions: list[int],
    own: list[int],
) -> SessionMapScores:
    """Score a map.

    Args:
        name: of the folder.
        grid: the map.
        T_world_map: (3, 3).
        truth: of all sessions.
        cells: the truth about the cells of `sessions`.
        sessions: their numbers, by date.
        own: index in `sessions` of those that the map was made from; the last one's surfaces
            count.
    """
    walls = truth.beams(sessions[own[-1]]).walls
    occupied = moved(T_world_map, grid.centres(np.argwhere(grid.occupied)))
    ghosts = occupied[distance_to_walls(occupied, walls) > GHOST_DISTANCE * grid.resolution]
    inside = ghosts[cells.lattice.holds(ghosts)]
    excused = _find_last_seen(cells, own).ravel()[cells.lattice.cells(inside)]
    hit = np.any([cells.seen[k].hits >= MIN_BEAMS for k in own], axis=0)
    wanted = cells.lattice.centres()[cells.fixed & hit]
    kept = is_near_occupied(grid, moved(se2.inverse(T_world_map), wanted))
    free_area = float(np.count_nonzero(grid.free)) * grid.resolution**2
    return SessionMapScores(
        name=name,
        occupied_cells=len(occupied),
        ghost_cells=len(ghosts),
        ghosts_per_100_m2=100.0 * len(ghosts) / free_area if free_area else float("nan"),
        avoidable_ghosts=len(ghosts) - int(excused.sum()),
        wall_cells=len(wanted),
        walls_kept=float(kept.mean()) if len(kept) else float("nan"),
    )


def _find_last_seen(cells: CellTruth, own: list[int]) -> NDArray[np.bool_]:
    """(H, W) cells within two of a surface that stood there when a session last looked."""
    stands = np.zeros(cells.lattice.shape, bool)
    for k in own:
        stands &= cells.seen[k].passes < MIN_BEAMS
        stands |= widen(widen(cells.surfaces[k]))
    return stands


def score_single(
    result: Path, truth: SessionTruth, cells: CellTruth, sessions: list[int]
) -> SessionMapScores:
    """Score the map of one session: its own surfaces count.

    Raises:
        InputError: it is no result of one of these sessions.
    """
    estimated = read_trajectory(result / "trajectory.tum")
    for k, number in enumerate(sessions):
        true = read_trajectory(truth.folder / truth.names[number] / "truth/trajectory.tum")
        if abs(true.stamp_s[0] - estimated.stamp_s[0]) > FRAME_DT:
            continue
        i, j = associate_trajectories(estimated.stamp_s, true.stamp_s, FRAME_DT)
        T_world_map = align(planar(estimated.poses[i]), planar(true.poses[j]))
        grid = read_grid(result)
        return score_place_map(result.name, grid, T_world_map, truth, cells, sessions, [k])
    hint = "of a session that the place has"
    raise InputError("is no result of these sessions", where=str(result), hint=hint)


@dataclass(frozen=True)
class PlaceScores(Scores):
    """Scores of a place.

    Attributes:
        sessions: poses of each session, in the order of the place.
        right, coarse, wrong, refused, refused_rightly: how many have this verdict.
        T_world_place: by which the place was laid on the world.
        changes: between the sessions.
        labels: of all sessions; None in 2D.
        maps: of the place, then of results of single sessions; none in 3D.
    """

    sessions: tuple[PoseScores, ...]
    right: int
    coarse: int
    wrong: int
    refused: int
    refused_rightly: int
    T_world_place: tuple[tuple[float, ...], ...]
    changes: ChangeScores
    labels: PlaceLabelScores | None
    maps: tuple[SessionMapScores, ...]


def score_place(place: Path, truth_folder: Path, singles: Sequence[Path] = ()) -> PlaceScores:
    """Score a place.

    Args:
        place: what `stillmap merge` wrote.
        truth_folder: what `stillmap simulate --sessions` wrote.
        singles: results of `stillmap map` of single sessions, for comparison of the maps.

    Raises:
        InputError: a file is missing or damaged, or does not match the others.
    """
    require_there(place, truth_folder, *singles)
    truth = load_session_truth(truth_folder)
    placed = read_sessions(place, truth)
    scores = score_poses(placed, truth)
    T_world_place, home = align_place(placed, truth)
    at_home = [one for one in placed if one.accepted and truth.place[one.number] == home]
    by_date = sorted(at_home, key=lambda one: one.number)
    labels: PlaceLabelScores | None = None
    maps: tuple[SessionMapScores, ...] = ()
    if truth.dimension == 2:
        changes, maps = _score_in_plane(place, truth, by_date, T_world_place, singles)
    else:
        changes, labels = _score_in_space(place, truth, by_date, T_world_place)
    verdicts = [one.verdict for one in scores]
    return PlaceScores(
        tuple(scores),
        verdicts.count("right"),
        verdicts.count("coarse"),
        verdicts.count("wrong"),
        verdicts.count("refused"),
        verdicts.count("refused rightly"),
        tuple(tuple(row) for row in T_world_place.tolist()),
        changes,
        labels,
        maps,
    )


def _score_in_plane(
    place: Path,
    truth: SessionTruth,
    sessions: list[PlacedSession],
    T_world_place: Float,
    singles: Sequence[Path],
) -> tuple[ChangeScores, tuple[SessionMapScores, ...]]:
    """Changes and maps of a place in 2D."""
    numbers = [one.number for one in sessions]
    cells = collect_cells(truth, numbers)
    named = read_named_cells(place, T_world_place)
    found = read_changes(place, sessions, T_world_place, cells, named)
    source = "boxes" if named is None else "cells"
    changes = score_changes(found, source, cells, truth, numbers)
    everyone = list(range(len(numbers)))
    own = score_place_map(
        place.name, read_grid(place), T_world_place, truth, cells, numbers, everyone
    )
    return changes, (own, *(score_single(one, truth, cells, numbers) for one in singles))


def _score_in_space(
    place: Path, truth: SessionTruth, sessions: list[PlacedSession], T_world_place: Float
) -> tuple[ChangeScores, PlaceLabelScores]:
    """Changes and labels of a place in 3D."""
    named = read_named_cells(place, T_world_place)
    if named is None:
        raise InputError("does not exist", where=str(place / "changes.npz"))
    numbers = [one.number for one in sessions]
    cells = collect_voxels(truth, numbers, named.points)
    found = read_changes(place, sessions, T_world_place, cells, named)
    changes = score_changes(found, "cells", cells, truth, numbers)
    return changes, score_place_labels(place, sessions, truth, cells)


def main() -> None:
    p = make_parser(__doc__)
    p.add_argument("place", type=Path, metavar="PLACE")
    p.add_argument("truth", type=Path, metavar="DAYS")
    p.add_argument("--single", type=Path, action="append", default=[], metavar="RESULT")
    args = p.parse_args()
    scores = score_place(args.place, args.truth, args.single)
    print(json.dumps(to_jsonable(scores.to_dict())))


if __name__ == "__main__":
    main()
