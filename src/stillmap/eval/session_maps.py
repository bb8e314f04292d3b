"""Scores of the map of a place, and of the maps of its sessions, against what truly stands."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.eval.labels import Scores
from stillmap.eval.map import GHOST_DISTANCE, distance_to_walls, is_near_occupied
from stillmap.eval.readers import read_trajectory
from stillmap.eval.session_cells import MIN_BEAMS, CellTruth, widen
from stillmap.eval.session_poses import FRAME_DT
from stillmap.eval.session_truth import SessionTruth
from stillmap.eval.trajectory import align, associate_trajectories, planar
from stillmap.results.reader import Grid, moved, read_grid

Float = NDArray[np.float64]


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
