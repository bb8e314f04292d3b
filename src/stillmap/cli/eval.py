"""`stillmap eval`: scores of trajectories, labels and maps, as text or as JSON."""

import argparse
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.errors import InputError
from stillmap.evaluation import files, folders, trajectory
from stillmap.evaluation.labels import LabelScores, label_scores
from stillmap.evaluation.map import (
    MapScores,
    map_scores,
    wall_cells_of_hits,
    wall_cells_of_map,
)
from stillmap.evaluation.relations import MAX_DT, RelationErrors, relation_errors

Float = NDArray[np.float64]

_TRAJECTORY = "rows 't x y theta' or TUM rows 'stamp x y z qx qy qz qw'"
_STAMP_TOLERANCE = 1e-6  # seconds: a result carries the stamps of its recording
_ASSOCIATION = 0.02  # seconds, between two systems' stamps of one scan


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add `eval` and its four scores."""
    parser = subparsers.add_parser(
        "eval",
        help="score a trajectory, labels or a map",
        description="Scores of a result. Each takes --json: one object on stdout.",
    )
    parser.set_defaults(run=run)
    scores = parser.add_subparsers(dest="score", required=True, metavar="SCORE")
    _add_relations(scores)
    _add_trajectory(scores)
    _add_labels(scores)
    _add_map(scores)
    for score in scores.choices.values():
        score.add_argument("--json", action="store_true", help="one JSON object on stdout")


def _add_relations(scores: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    what = "errors of known displacements between pairs of poses (Kuemmerle et al. 2009)"
    parser = scores.add_parser("relations", help=what, description=what)
    parser.add_argument("trajectory", type=Path, metavar="TRAJ", help=_TRAJECTORY)
    parser.add_argument(
        "relations", type=Path, metavar="RELATIONS", help="rows 't1 t2 x y z roll pitch yaw'"
    )
    parser.add_argument(
        "--odom",
        type=Path,
        metavar="FILE",
        help="CARMEN log (.gz too) or trajectory that reaches times without a pose near them",
    )
    parser.add_argument(
        "--max-dt",
        type=_seconds,
        default=MAX_DT,
        metavar="S",
        help="a pose this near to a time stands for it, seconds (default %(default)s)",
    )
    parser.add_argument(
        "--compose",
        action="store_true",
        help="error as a displacement between displacements, not as difference of components",
    )
    parser.set_defaults(evaluate=_relations)


def _add_trajectory(scores: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    what = "absolute and relative errors against a reference (ATE, RPE)"
    parser = scores.add_parser("trajectory", help=what, description=what)
    parser.add_argument("trajectory", type=Path, metavar="TRAJ", help=_TRAJECTORY)
    parser.add_argument("reference", type=Path, metavar="REFERENCE", help=_TRAJECTORY)
    parser.add_argument(
        "--max-dt",
        type=_seconds,
        default=_ASSOCIATION,
        metavar="S",
        help="stamps this near belong together, seconds (default %(default)s)",
    )
    parser.add_argument(
        "--delta",
        type=_positive,
        default=1.0,
        metavar="N",
        help="relative errors between poses this far apart (default %(default)s)",
    )
    parser.add_argument(
        "--delta-unit",
        choices=("m", "frames"),
        default="m",
        help="metres along the reference, or poses (default %(default)s)",
    )
    parser.set_defaults(evaluate=_trajectory)


def _add_labels(scores: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    what = "static or dynamic per beam, against a simulation's truth; dynamic is the positive class"
    parser = scores.add_parser("labels", help=what, description=what)
    _add_result_and_truth(parser)
    parser.set_defaults(evaluate=_labels)


def _add_map(scores: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    what = "ghost cells and walls kept, against a simulation's truth"
    parser = scores.add_parser("map", help=what, description=what)
    _add_result_and_truth(parser)
    parser.add_argument(
        "--reference",
        type=Path,
        metavar="OTHER_RESULT",
        help="the walls to keep are those of this map, say of the same run without people "
        "(default: where true static hits lie)",
    )
    parser.add_argument(
        "--reference-truth",
        type=Path,
        metavar="DIR",
        help="truth of that other run (default: TRUTH_DIR)",
    )
    parser.set_defaults(evaluate=_map)


def _add_result_and_truth(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("result", type=Path, metavar="RESULT_DIR", help="what 'stillmap map' wrote")
    parser.add_argument(
        "truth", type=Path, metavar="TRUTH_DIR", help="what 'stillmap simulate' wrote"
    )


def run(args: argparse.Namespace) -> int:
    """Compute and print one score.

    Raises:
        InputError: a file is missing, damaged, or does not go with the others.
    """
    scores, lines = args.evaluate(args)
    print(json.dumps(scores, allow_nan=False) if args.json else "\n".join(lines))
    return 0


Output = tuple[dict[str, Any], Iterable[str]]


def _relations(args: argparse.Namespace) -> Output:
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


def _trajectory(args: argparse.Namespace) -> Output:
    estimated = files.read_trajectory(args.trajectory)
    reference = files.read_trajectory(args.reference)
    i, j = _associated(estimated, reference.stamp_s, args.max_dt, args.trajectory)
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


def _labels(args: argparse.Namespace) -> Output:
    labels, truth = folders.read_labels(args.result), folders.read_truth(args.truth)
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


def _map(args: argparse.Namespace) -> Output:
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
    path = result / "trajectory.tum"
    estimated = files.read_trajectory(path)
    i, j = _associated(estimated, files.seconds(truth.recording.stamp_ns), _STAMP_TOLERANCE, path)
    return trajectory.align(trajectory.planar(estimated.poses[i]), truth.poses()[j])


def _map_lines(s: MapScores) -> Iterable[str]:
    x, y, theta = s.T_world_map
    yield f"alignment    {x:.3f} m, {y:.3f} m, {np.degrees(theta):.3f} deg (map to world)"
    yield (
        f"ghost cells  {s.ghost_cells} of {s.occupied_cells} occupied: "
        f"{s.ghosts_per_100_m2:.3f} per 100 m2 of {s.free_area:.1f} m2 free"
    )
    yield f"walls kept   {100 * s.walls_kept:.2f} % of {s.reference_wall_cells} cells"


def _associated(
    estimated: files.Trajectory, reference_s: Float, max_dt: float, path: Path
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    try:
        return trajectory.associate(estimated.stamp_s, reference_s, max_dt)
    except InputError as error:
        raise InputError(error.what, where=str(path), hint=error.hint) from error


def _seconds(text: str) -> float:
    value = float(text)
    if not 0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"wants seconds, 0 or more, got {text}")
    return value


def _positive(text: str) -> float:
    value = float(text)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"wants a number above 0, got {text}")
    return value
