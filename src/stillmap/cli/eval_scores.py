"""Compute and format the scores of `stillmap eval`."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.core.grid_map import is_inside
from stillmap.results.eval import readers, trajectory
from stillmap.results.eval.labels import LabelScores, score_labels
from stillmap.results.eval.map import (
    MapScores,
    extract_wall_cells,
    extract_wall_cells_from_hits,
    score_map,
)
from stillmap.results.eval.readers import Truth, read_truth, require_same_beams
from stillmap.results.eval.relations import RelationErrors, compute_relation_errors
from stillmap.results.eval.trajectory import read_paired_poses
from stillmap.results.folder import read_region
from stillmap.results.reader import (
    is_place,
    moved,
    read_grid,
    read_labels,
    require_there,
)

Scores = tuple[dict[str, Any], Iterable[str]]  # as JSON, as lines of text


def score_relations(
    trajectory_path: Path, relations: Path, odometry: Path | None, max_dt: float, compose: bool
) -> Scores:
    """Errors of known displacements."""
    errors = compute_relation_errors(
        readers.read_planar_trajectory(trajectory_path),
        readers.read_relations(relations),
        readers.read_odometry(odometry) if odometry else None,
        max_dt,
        compose,
    )
    if not errors.used:
        raise InputError(
            f"no relation has a pose of {trajectory_path} within {max_dt:g} s at both ends",
            where=str(relations),
            hint="other clocks? --odom reaches further",
        )
    return errors.to_dict(), _format_relations(errors)


def _format_relations(errors: RelationErrors) -> Iterable[str]:
    yield (
        f"relations    {errors.relations}, used {errors.used} "
        f"(stamps {errors.stamps}, by odometry {errors.stamps_by_odometry})"
    )
    for name, unit, e in (
        ("translation", "m", errors.translation),
        ("rotation", "deg", errors.rotation),
    ):
        yield (
            f"{name:12} {e.mean:.4f} +- {e.std:.4f} {unit}, median {e.median:.4f}, "
            f"max {e.max:.4f}, squared {e.squared_mean:.4f} +- {e.squared_std:.4f} {unit}2"
        )


def score_trajectory(
    trajectory_path: Path,
    reference_path: Path,
    max_dt: float,
    delta: float,
    delta_unit: Literal["m", "frames"],
) -> Scores:
    """Absolute and relative trajectory errors (ATE, RPE)."""
    estimated = readers.read_trajectory(trajectory_path)
    reference = readers.read_trajectory(reference_path)
    try:
        i, j = trajectory.associate_trajectories(estimated.stamp_s, reference.stamp_s, max_dt)
    except InputError as error:
        raise InputError(error.what, where=str(trajectory_path), hint=error.hint) from error
    P, Q = trajectory.project_flat_trajectories(estimated.poses[i], reference.poses[j])
    absolute = trajectory.compute_absolute_errors(P, Q)
    relative = trajectory.compute_relative_errors(P, Q, delta, delta_unit)
    scores = {
        "poses": len(i),
        "dimension": P.shape[-1] - 1,
        "ate": absolute.to_dict(),
        "rpe": {"delta": delta, "delta_unit": delta_unit, **relative.to_dict()},
    }
    lines = [
        f"poses paired     {len(i)} of {len(estimated.stamp_s)}",
        f"ATE              {_format_stats(absolute, 'm')}",
        f"RPE, {delta:g} {delta_unit}".ljust(17) + f"{relative.pairs} pairs",
        f"  translation    {_format_stats(relative.translation, 'm')}",
        f"  rotation       {_format_stats(relative.rotation, 'deg')}",
    ]
    return scores, lines


def _format_stats(e: trajectory.ErrorStats, unit: str) -> str:
    return f"rmse {e.rmse:.4f} {unit}, mean {e.mean:.4f}, median {e.median:.4f}, max {e.max:.4f}"


def score_beam_labels(result: Path, truth_folder: Path) -> Scores:
    """Static or dynamic, per beam."""
    require_there(result, truth_folder)
    if is_place(result):
        hint = f"one of its sessions: stillmap eval labels {result}/sessions/NAME {truth_folder}"
        raise InputError("is a place of several recordings", where=str(result), hint=hint)
    labels = read_labels(result)
    truth = read_truth(truth_folder, labels)
    require_same_beams(labels, truth, result)
    scores = score_labels(labels.p_static, truth.static(), labels.hit & truth.recording.hit)
    return scores.to_dict(), _format_labels(scores)


def _format_labels(s: LabelScores) -> Iterable[str]:
    yield f"beams that hit     {s.hits}, {s.dynamic} dynamic, {s.unlabelled} more without a label"
    yield f"average precision  {s.average_precision:.4f}"
    yield f"at 1/2             F1 {s.f1:.4f}, precision {s.precision:.4f}, recall {s.recall:.4f}"
    yield f"called dynamic     {100 * s.share_called_dynamic:.3f} %"
    yield f"Brier              {s.brier:.5f}"
    yield f"log loss           {s.log_loss:.5f}"
    yield f"ECE                {s.ece:.4f}, {s.ece_unsure:.4f} over the {s.unsure} unsure ones"


def score_grid(
    result: Path, truth_folder: Path, reference: Path | None, reference_truth: Path | None
) -> Scores:
    """Ghost cells and walls kept."""
    others = [path for path in (reference, reference_truth) if path is not None]
    require_there(result, truth_folder, *others)
    truth = read_truth(truth_folder)
    grid, walls = read_grid(result), truth.walls()
    T_world_map = _align(result, truth)
    if reference is None:
        wanted = extract_wall_cells_from_hits(truth.static_hits(), walls, grid, T_world_map)
    else:
        other = read_truth(reference_truth) if reference_truth else truth
        wanted = extract_wall_cells(read_grid(reference), walls, _align(reference, other))
    region = read_region(result)
    if region is not None:
        wanted = wanted[is_inside(moved(se2.inverse(T_world_map), wanted), region)]
    # things brought in that stay are not ghosts
    solid = np.concatenate([walls, truth.lasting()])
    scores = score_map(grid, solid, wanted, T_world_map)
    return scores.to_dict(), _format_map(scores)


def _align(result: Path, truth: Truth) -> NDArray[np.float64]:
    """Align trajectories: T_world_map of a result whose map frame starts at its first pose."""
    poses, true_poses = read_paired_poses(result, truth)
    return trajectory.align(trajectory.planar(poses), true_poses)


def _format_map(s: MapScores) -> Iterable[str]:
    x, y, theta = s.T_world_map
    yield f"alignment    {x:.3f} m, {y:.3f} m, {np.degrees(theta):.3f} deg (map to world)"
    yield (
        f"ghost cells  {s.ghost_cells} of {s.occupied_cells} occupied: "
        f"{s.ghosts_per_100_m2:.3f} per 100 m2 of {s.free_area:.1f} m2 free"
    )
    yield f"walls kept   {100 * s.walls_kept:.2f} % of {s.reference_wall_cells} cells"
