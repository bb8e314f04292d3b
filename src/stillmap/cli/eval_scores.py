"""The scores of `stillmap eval`, as JSON values."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.core.grid_map import is_inside
from stillmap.results.eval import readers, trajectory
from stillmap.results.eval.labels import score_labels
from stillmap.results.eval.map import (
    extract_wall_cells,
    extract_wall_cells_from_hits,
    score_map,
)
from stillmap.results.eval.readers import Truth, read_truth, require_same_beams
from stillmap.results.eval.trajectory import compute_relation_errors, read_paired_poses
from stillmap.results.folder import read_region
from stillmap.results.reader import (
    is_place,
    moved,
    read_grid,
    read_labels,
    require_there,
)


def _score_relations(args: argparse.Namespace) -> dict[str, Any]:
    """Errors of known displacements."""
    errors = compute_relation_errors(
        readers.read_planar_trajectory(args.trajectory),
        readers.read_relations(args.relations),
        readers.read_odometry(args.odom) if args.odom else None,
        args.max_dt,
        args.compose,
    )
    if not errors.used:
        raise InputError(
            f"no relation has a pose of {args.trajectory} within {args.max_dt:g} s at both ends",
            where=str(args.relations),
            hint="other clocks? --odom reaches further",
        )
    return errors.to_dict()


def _score_trajectory(args: argparse.Namespace) -> dict[str, Any]:
    """Absolute and relative trajectory errors (ATE, RPE)."""
    estimated = readers.read_trajectory(args.trajectory)
    reference = readers.read_trajectory(args.reference)
    try:
        i, j = trajectory.associate_trajectories(estimated.stamp_s, reference.stamp_s, args.max_dt)
    except InputError as error:
        raise InputError(error.what, where=str(args.trajectory), hint=error.hint) from error
    P, Q = trajectory.project_flat_trajectories(estimated.poses[i], reference.poses[j])
    relative = trajectory.compute_relative_errors(P, Q, args.delta, args.delta_unit)
    return {
        "poses": len(i),
        "dimension": P.shape[-1] - 1,
        "ate": trajectory.compute_absolute_errors(P, Q).to_dict(),
        "rpe": {"delta": args.delta, "delta_unit": args.delta_unit, **relative.to_dict()},
    }


def _score_labels(args: argparse.Namespace) -> dict[str, Any]:
    """Static or dynamic, per beam."""
    result, truth_folder = args.result, args.truth
    require_there(result, truth_folder)
    if is_place(result):
        hint = f"one of its sessions: stillmap eval labels {result}/sessions/NAME {truth_folder}"
        raise InputError("is a place of several recordings", where=str(result), hint=hint)
    labels = read_labels(result)
    truth = read_truth(truth_folder, labels)
    require_same_beams(labels, truth, result)
    return score_labels(labels.p_static, truth.static(), labels.hit & truth.recording.hit).to_dict()


def _score_map(args: argparse.Namespace) -> dict[str, Any]:
    """Ghost cells and walls kept."""
    result, reference = args.result, args.reference
    require_there(result, args.truth, *filter(None, (reference, args.reference_truth)))
    truth = read_truth(args.truth)
    grid, walls = read_grid(result), truth.walls()
    T_world_map = _align(result, truth)
    if reference is None:
        targets = extract_wall_cells_from_hits(truth.static_hits(), walls, grid, T_world_map)
    else:
        other = read_truth(args.reference_truth) if args.reference_truth else truth
        targets = extract_wall_cells(read_grid(reference), walls, _align(reference, other))
    region = read_region(result)
    if region is not None:
        targets = targets[is_inside(moved(se2.inverse(T_world_map), targets), region)]
    # things brought in that stay are not ghosts
    solid = np.concatenate([walls, truth.lasting()])
    return score_map(grid, solid, targets, T_world_map).to_dict()


def _align(result: Path, truth: Truth) -> NDArray[np.float64]:
    """Align trajectories: T_world_map of a result whose map frame starts at its first pose."""
    poses, true_poses = read_paired_poses(result, truth)
    return trajectory.align(trajectory.planar(poses), true_poses)


SCORES = {
    "relations": _score_relations,
    "trajectory": _score_trajectory,
    "labels": _score_labels,
    "map": _score_map,
}
