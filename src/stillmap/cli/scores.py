"""What `stillmap eval` computes: each score as a dictionary and as lines to read."""

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.cli.model_scores import of_model
from stillmap.errors import InputError
from stillmap.evaluation import files, folders, trajectory
from stillmap.evaluation.labels import LabelScores, label_scores
from stillmap.evaluation.map import (
    MapScores,
    map_scores,
    wall_cells_of_hits,
    wall_cells_of_map,
)
from stillmap.evaluation.pairing import paired
from stillmap.evaluation.relations import RelationErrors, relation_errors

Float = NDArray[np.float64]

Scores = tuple[dict[str, Any], Iterable[str]]


def of_relations(args: argparse.Namespace) -> Scores:
    """Errors of known displacements."""
    errors = relation_errors(
        files.read_planar(args.trajectory),
        files.read_relations(args.relations),
        files.read_odometry(args.odom) if args.odom else None,
        args.max_dt,
        args.compose,
    )
    if not errors.used:
        raise InputError(
            f"no relation has a pose of {args.trajectory} within {args.max_dt:g} s at both ends",
            where=str(args.relations),
            hint="other clocks? --odom reaches further",
        )
    return errors.to_dict(), _relation_lines(errors)


def _relation_lines(errors: RelationErrors) -> Iterable[str]:
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


def of_trajectory(args: argparse.Namespace) -> Scores:
    """ATE and RPE."""
    estimated = files.read_trajectory(args.trajectory)
    reference = files.read_trajectory(args.reference)
    try:
        i, j = trajectory.associate(estimated.stamp_s, reference.stamp_s, args.max_dt)
    except InputError as error:
        raise InputError(error.what, where=str(args.trajectory), hint=error.hint) from error
    P, Q = trajectory.to_plane_where_flat(estimated.poses[i], reference.poses[j])
    absolute = trajectory.absolute_errors(P, Q)
    relative = trajectory.relative_errors(P, Q, args.delta, args.delta_unit)
    scores = {
        "poses": len(i),
        "dimension": P.shape[-1] - 1,
        "ate": absolute.to_dict(),
        "rpe": {"delta": args.delta, "delta_unit": args.delta_unit, **relative.to_dict()},
    }
    lines = [
        f"poses paired     {len(i)} of {len(estimated.stamp_s)}",
        f"ATE              {_stats(absolute, 'm')}",
        f"RPE, {args.delta:g} {args.delta_unit}".ljust(17) + f"{relative.pairs} pairs",
        f"  translation    {_stats(relative.translation, 'm')}",
        f"  rotation       {_stats(relative.rotation, 'deg')}",
    ]
    return scores, lines


def _stats(e: trajectory.ErrorStats, unit: str) -> str:
    return f"rmse {e.rmse:.4f} {unit}, mean {e.mean:.4f}, median {e.median:.4f}, max {e.max:.4f}"


def of_labels(args: argparse.Namespace) -> Scores:
    """Static or dynamic, per beam."""
    folders.require_there(args.result, args.truth)
    labels = folders.read_labels(args.result)
    truth = folders.read_truth(args.truth, labels)
    folders.require_same_beams(labels, truth, args.result)
    scores = label_scores(labels.p_static, truth.static(), labels.hit & truth.recording.hit)
    return scores.to_dict(), _label_lines(scores)


def _label_lines(s: LabelScores) -> Iterable[str]:
    yield f"beams that hit     {s.hits}, {s.dynamic} dynamic, {s.unlabelled} more without a label"
    yield f"average precision  {s.average_precision:.4f}"
    yield f"at 1/2             F1 {s.f1:.4f}, precision {s.precision:.4f}, recall {s.recall:.4f}"
    yield f"called dynamic     {100 * s.share_called_dynamic:.3f} %"
    yield f"Brier              {s.brier:.5f}"
    yield f"log loss           {s.log_loss:.5f}"
    yield f"ECE                {s.ece:.4f}, {s.ece_unsure:.4f} over the {s.unsure} unsure ones"


def of_map(args: argparse.Namespace) -> Scores:
    """Ghosts and walls."""
    others = [path for path in (args.reference, args.reference_truth) if path is not None]
    folders.require_there(args.result, args.truth, *others)
    truth = folders.read_truth(args.truth)
    grid, walls = folders.read_grid(args.result), truth.walls()
    T_world_map = _alignment(args.result, truth)
    if args.reference is None:
        wanted = wall_cells_of_hits(truth.static_hits(), walls, grid, T_world_map)
    else:
        other = folders.read_truth(args.reference_truth) if args.reference_truth else truth
        wanted = wall_cells_of_map(
            folders.read_grid(args.reference), walls, _alignment(args.reference, other)
        )
    # what was brought and is still there is no ghost
    solid = np.concatenate([walls, truth.lasting()])
    scores = map_scores(grid, solid, wanted, T_world_map)
    return scores.to_dict(), _map_lines(scores)


def _alignment(result: Path, truth: folders.Truth) -> Float:
    """T_world_map of a result: the map frame is where its trajectory started, not the world's."""
    poses, true_poses = paired(result, truth)
    return trajectory.align(trajectory.planar(poses), true_poses)


def _map_lines(s: MapScores) -> Iterable[str]:
    x, y, theta = s.T_world_map
    yield f"alignment    {x:.3f} m, {y:.3f} m, {np.degrees(theta):.3f} deg (map to world)"
    yield (
        f"ghost cells  {s.ghost_cells} of {s.occupied_cells} occupied: "
        f"{s.ghosts_per_100_m2:.3f} per 100 m2 of {s.free_area:.1f} m2 free"
    )
    yield f"walls kept   {100 * s.walls_kept:.2f} % of {s.reference_wall_cells} cells"


SCORES = {
    "relations": of_relations,
    "trajectory": of_trajectory,
    "labels": of_labels,
    "map": of_map,
    "model": of_model,
}
