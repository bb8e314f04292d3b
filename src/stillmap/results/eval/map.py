"""Scores of an occupancy map against the true walls: ghost cells, and share of walls kept."""

from dataclasses import dataclass

import numpy as np
import scipy  # its parts load when they are first used

from stillmap.core import se2
from stillmap.core.array_types import Bool, Float
from stillmap.results.eval.labels import Scores
from stillmap.results.reader import Grid, moved

GHOST_DISTANCE = 2.0  # cells from the nearest wall

WALL_DISTANCE = 1.0  # cells

MIN_HITS = 3  # fewer are noise from a neighbouring cell, or a wall hardly observed


@dataclass(frozen=True)
class MapScores(Scores):
    """NaN where a denominator is zero.

    Attributes:
        ghost_cells: occupied cells whose center lies more than two cells from any wall.
        free_area: m2 of free cells.
        ghosts_per_100_m2: ghost cells per 100 m2 of free area.
        reference_wall_cells: wall cells that the map should show.
        walls_kept: share of these that are occupied, or one of whose 8 neighbours is.
        T_world_map: x, y, theta of the alignment used.
    """

    resolution: float
    occupied_cells: int
    ghost_cells: int
    free_area: float
    ghosts_per_100_m2: float
    reference_wall_cells: int
    walls_kept: float
    T_world_map: tuple[float, float, float]


def score_map(grid: Grid, walls: Float, reference: Float, T_world_map: Float) -> MapScores:
    """Score a map.

    Args:
        grid: the map.
        walls: (W, 4) segments x0, y0, x1, y1 in the world frame, W >= 1.
        reference: (K, 2) centers, in the world frame, of the wall cells that the map should show:
            from `extract_wall_cells` or `extract_wall_cells_from_hits`.
        T_world_map: (3, 3), see `trajectory.align`.
    """
    occupied = moved(T_world_map, grid.centres(np.argwhere(grid.occupied)))
    ghosts = int(np.sum(distance_to_walls(occupied, walls) > GHOST_DISTANCE * grid.resolution))
    free_area = float(np.count_nonzero(grid.free)) * grid.resolution**2
    kept = is_near_occupied(grid, moved(se2.inverse(T_world_map), reference))
    x, y, theta = se2.parameters(T_world_map).tolist()
    return MapScores(
        resolution=grid.resolution,
        occupied_cells=len(occupied),
        ghost_cells=ghosts,
        free_area=free_area,
        ghosts_per_100_m2=100.0 * ghosts / free_area if free_area else float("nan"),
        reference_wall_cells=len(reference),
        walls_kept=float(kept.mean()) if len(kept) else float("nan"),
        T_world_map=(x, y, theta),
    )


def extract_wall_cells(grid: Grid, walls: Float, T_world_map: Float) -> Float:
    """(K, 2) centers, in the world frame, of a map's occupied cells within one cell of a wall."""
    centres = moved(T_world_map, grid.centres(np.argwhere(grid.occupied)))
    return centres[distance_to_walls(centres, walls) <= WALL_DISTANCE * grid.resolution]


def extract_wall_cells_from_hits(
    hits: Float, walls: Float, grid: Grid, T_world_map: Float
) -> Float:
    """(K, 2) centers, in the world frame, of cells beside walls with MIN_HITS hits.

    Args:
        hits: (N, 2) end points of static beams in the world frame, at true poses.
        walls: (W, 4) segments.
        grid: the map, for its lattice.
        T_world_map: (3, 3).
    """
    hit_cells = grid.cells(moved(se2.inverse(T_world_map), hits))
    cells, count = np.unique(hit_cells, axis=0, return_counts=True)
    centres = moved(T_world_map, grid.centres(cells[count >= MIN_HITS]))
    return centres[distance_to_walls(centres, walls) <= WALL_DISTANCE * grid.resolution]


def distance_to_walls(points: Float, walls: Float, chunk: int = 1 << 20) -> Float:
    """(N,) distances of (N, 2) points to the nearest of (W, 4) segments."""
    start, along = walls[:, :2], walls[:, 2:] - walls[:, :2]
    length_squared = np.maximum(np.sum(along**2, axis=1), np.finfo(float).tiny)
    out = np.empty(len(points))
    step = max(chunk // len(walls), 1)
    for k in range(0, len(points), step):
        from_start = points[k : k + step, None] - start
        share = np.clip(np.sum(from_start * along, axis=2) / length_squared, 0.0, 1.0)
        off = from_start - share[..., None] * along
        out[k : k + step] = np.sqrt(np.sum(off**2, axis=2).min(axis=1))
    return out


def is_near_occupied(grid: Grid, points: Float) -> Bool:
    """(N,) whether the cell of each point (N, 2) of the map frame, or a neighbour, is occupied."""
    near = scipy.ndimage.binary_dilation(np.pad(grid.occupied, 1), np.ones((3, 3), bool))
    cells = grid.cells(points) + 1
    inside = np.all((cells >= 0) & (cells < near.shape), axis=1)
    out = np.zeros(len(points), bool)
    out[inside] = near[tuple(cells[inside].T)]
    return out
