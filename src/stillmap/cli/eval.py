"""`stillmap eval`: scores of trajectories, labels, maps and models, as text or as JSON.

Imports that take long are made inside the functions, so that `--help` and completion are quick.
"""

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stillmap.cli.console import print_json
from stillmap.cli.parser import COMMANDS
from stillmap.core.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from stillmap.eval import trajectory
    from stillmap.eval.labels import LabelScores
    from stillmap.eval.map import MapScores
    from stillmap.eval.readers import Truth
    from stillmap.eval.relations import RelationErrors


Scores = tuple[dict[str, Any], Iterable[str]]

_TRAJECTORY = "rows 't x y theta' or TUM rows 'stamp x y z qx qy qz qw'"

_RELATION = 0.1  # seconds from a relation's time to a pose, as in the authors' program

_ASSOCIATION = 0.02  # seconds, between two systems' stamps of one scan

_EPILOG = """examples:
  stillmap eval relations out/trajectory.tum log.relations
  stillmap eval trajectory out/trajectory.tum truth.tum --json
  stillmap eval labels out sim
  stillmap eval map out sim
  stillmap eval model out sim
"""


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add `eval` and its five scores."""
    parser = subparsers.add_parser(
        "eval",
        help=COMMANDS["eval"],
        description="Score a result, as text or with --json as one object on stdout. `relations` "
        "and `trajectory` compare poses with a reference; `labels`, `map` and `model` compare a "
        "result with the truth that `stillmap simulate` writes.",
        epilog=_EPILOG,
    )
    parser.set_defaults(run=run)
    scores = parser.add_subparsers(title="scores", dest="score", required=True, metavar="SCORE")
    _add_relations(scores)
    _add_trajectory(scores)
    _add_labels(scores)
    _add_map(scores)
    _add_model(scores)
    for score in scores.choices.values():
        score.add_argument("--json", action="store_true", help="one JSON object on stdout")


def _add_relations(scores: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    parser = scores.add_parser(
        "relations",
        help="known displacements between pairs of poses",
        description="Errors of known displacements between pairs of poses (Kuemmerle et al. 2009).",
        epilog="examples:\n"
        "  stillmap eval relations out/trajectory.tum log.relations\n"
        "  stillmap eval relations out/trajectory.tum log.relations --odom log.clf.gz --json\n",
    )
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
        default=_RELATION,
        metavar="S",
        help="a pose this near to a time stands for it, seconds (default: %(default)s)",
    )
    parser.add_argument(
        "--compose",
        action="store_true",
        help="error as a displacement between displacements, not as difference of components",
    )


def _add_trajectory(scores: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    parser = scores.add_parser(
        "trajectory",
        help="absolute and relative errors against a reference",
        description="Absolute and relative errors of a trajectory against a reference (ATE, RPE).",
        epilog="examples:\n"
        "  stillmap eval trajectory out/trajectory.tum sim/truth/trajectory.tum\n"
        "  stillmap eval trajectory out/trajectory.tum truth.tum --delta 10 --delta-unit frames\n",
    )
    parser.add_argument("trajectory", type=Path, metavar="TRAJ", help=_TRAJECTORY)
    parser.add_argument("reference", type=Path, metavar="REFERENCE", help=_TRAJECTORY)
    parser.add_argument(
        "--max-dt",
        type=_seconds,
        default=_ASSOCIATION,
        metavar="S",
        help="stamps this near belong together, seconds (default: %(default)s)",
    )
    parser.add_argument(
        "--delta",
        type=_positive,
        default=1.0,
        metavar="N",
        help="relative errors between poses this far apart (default: %(default)s)",
    )
    parser.add_argument(
        "--delta-unit",
        choices=("m", "frames"),
        default="m",
        help="metres along the reference, or poses (default: %(default)s)",
    )


def _add_labels(scores: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    parser = scores.add_parser(
        "labels",
        help="static or dynamic per beam, against a simulation's truth",
        description="How well beams are told apart, against a simulation's truth; dynamic is the "
        "positive class.",
        epilog="examples:\n  stillmap eval labels out sim\n  stillmap eval labels out sim --json\n",
    )
    _add_result_and_truth(parser)


def _add_map(scores: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    parser = scores.add_parser(
        "map",
        help="ghost cells and walls kept, against a simulation's truth",
        description="Cells that are occupied where nothing stands, and the share of the walls that "
        "the map shows, against a simulation's truth.",
        epilog="examples:\n"
        "  stillmap eval map out sim\n"
        "  stillmap eval map out sim --reference out-empty --reference-truth sim-empty\n",
    )
    _add_result_and_truth(parser)
    parser.add_argument(
        "--reference",
        type=Path,
        metavar="OTHER_RESULT_DIR",
        help="the walls to keep are those of this map, say of the same run without people "
        "(default: where true static hits lie)",
    )
    parser.add_argument(
        "--reference-truth",
        type=Path,
        metavar="DIR",
        help="truth of that other run (default: TRUTH_DIR)",
    )


def _add_model(scores: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    parser = scores.add_parser(
        "model",
        help="surface, texture and models of movers, against a simulation's truth",
        description="How far the mesh lies from the true surface, and how much of that it shows; "
        "how much of the texture shows movers, and how far its colours are off; shapes and "
        "textures of the models of what moved. The simulation needs cameras.",
        epilog="examples:\n"
        "  stillmap eval model out sim\n"
        "  stillmap eval model out sim --within 20 --json\n",
    )
    _add_result_and_truth(parser)
    parser.add_argument(
        "--within",
        type=_positive,
        default=float("inf"),
        metavar="M",
        help="only what beams and pictures saw from no farther should be there (default: all)",
    )


def _add_result_and_truth(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("result", type=Path, metavar="RESULT_DIR", help="what `stillmap map` wrote")
    parser.add_argument(
        "truth", type=Path, metavar="TRUTH_DIR", help="what `stillmap simulate` wrote"
    )


def run(args: argparse.Namespace) -> int:
    """Compute and print one score.

    Raises:
        InputError: a file is missing, damaged, or does not go with the others.
    """
    scores, lines = _SCORES[args.score](args)
    if args.json:
        print_json(scores)
    else:
        print("\n".join(lines))
    return 0


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


def _score_relations(args: argparse.Namespace) -> Scores:
    """Errors of known displacements."""
    from stillmap.eval import readers
    from stillmap.eval.relations import compute_relation_errors

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
    return errors.to_dict(), _relation_lines(errors)


def _relation_lines(errors: "RelationErrors") -> Iterable[str]:
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


def _score_trajectory(args: argparse.Namespace) -> Scores:
    """ATE and RPE."""
    from stillmap.eval import readers, trajectory

    estimated = readers.read_trajectory(args.trajectory)
    reference = readers.read_trajectory(args.reference)
    try:
        i, j = trajectory.associate_trajectories(estimated.stamp_s, reference.stamp_s, args.max_dt)
    except InputError as error:
        raise InputError(error.what, where=str(args.trajectory), hint=error.hint) from error
    P, Q = trajectory.project_flat_trajectories(estimated.poses[i], reference.poses[j])
    absolute = trajectory.compute_absolute_errors(P, Q)
    relative = trajectory.compute_relative_errors(P, Q, args.delta, args.delta_unit)
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


def _stats(e: "trajectory.ErrorStats", unit: str) -> str:
    return f"rmse {e.rmse:.4f} {unit}, mean {e.mean:.4f}, median {e.median:.4f}, max {e.max:.4f}"


def _score_labels(args: argparse.Namespace) -> Scores:
    """Static or dynamic, per beam."""
    from stillmap.eval.labels import score_labels
    from stillmap.eval.readers import read_truth, require_same_beams
    from stillmap.results.labels import read_labels
    from stillmap.results.reader import require_there

    require_there(args.result, args.truth)
    labels = read_labels(args.result)
    truth = read_truth(args.truth, labels)
    require_same_beams(labels, truth, args.result)
    scores = score_labels(labels.p_static, truth.static(), labels.hit & truth.recording.hit)
    return scores.to_dict(), _label_lines(scores)


def _label_lines(s: "LabelScores") -> Iterable[str]:
    yield f"beams that hit     {s.hits}, {s.dynamic} dynamic, {s.unlabelled} more without a label"
    yield f"average precision  {s.average_precision:.4f}"
    yield f"at 1/2             F1 {s.f1:.4f}, precision {s.precision:.4f}, recall {s.recall:.4f}"
    yield f"called dynamic     {100 * s.share_called_dynamic:.3f} %"
    yield f"Brier              {s.brier:.5f}"
    yield f"log loss           {s.log_loss:.5f}"
    yield f"ECE                {s.ece:.4f}, {s.ece_unsure:.4f} over the {s.unsure} unsure ones"


def _score_map(args: argparse.Namespace) -> Scores:
    """Ghosts and walls."""
    import numpy as np

    from stillmap.eval.map import extract_wall_cells, extract_wall_cells_from_hits, score_map
    from stillmap.eval.readers import read_truth
    from stillmap.results.reader import read_grid, require_there

    others = [path for path in (args.reference, args.reference_truth) if path is not None]
    require_there(args.result, args.truth, *others)
    truth = read_truth(args.truth)
    grid, walls = read_grid(args.result), truth.walls()
    T_world_map = _alignment(args.result, truth)
    if args.reference is None:
        wanted = extract_wall_cells_from_hits(truth.static_hits(), walls, grid, T_world_map)
    else:
        other = read_truth(args.reference_truth) if args.reference_truth else truth
        wanted = extract_wall_cells(
            read_grid(args.reference), walls, _alignment(args.reference, other)
        )
    # what was brought and is still there is no ghost
    solid = np.concatenate([walls, truth.lasting()])
    scores = score_map(grid, solid, wanted, T_world_map)
    return scores.to_dict(), _map_lines(scores)


def _alignment(result: Path, truth: "Truth") -> "NDArray[np.float64]":
    """T_world_map of a result: the map frame is where its trajectory started, not the world's."""
    from stillmap.eval import trajectory
    from stillmap.eval.trajectory import read_paired_poses

    poses, true_poses = read_paired_poses(result, truth)
    return trajectory.align(trajectory.planar(poses), true_poses)


def _map_lines(s: "MapScores") -> Iterable[str]:
    import numpy as np

    x, y, theta = s.T_world_map
    yield f"alignment    {x:.3f} m, {y:.3f} m, {np.degrees(theta):.3f} deg (map to world)"
    yield (
        f"ghost cells  {s.ghost_cells} of {s.occupied_cells} occupied: "
        f"{s.ghosts_per_100_m2:.3f} per 100 m2 of {s.free_area:.1f} m2 free"
    )
    yield f"walls kept   {100 * s.walls_kept:.2f} % of {s.reference_wall_cells} cells"


def _score_model(args: argparse.Namespace) -> Scores:
    from stillmap.cli.eval_model import score_model

    return score_model(args)


_SCORES = {
    "relations": _score_relations,
    "trajectory": _score_trajectory,
    "labels": _score_labels,
    "map": _score_map,
    "model": _score_model,
}
