"""`stillmap eval`: score trajectories, labels and maps, as text or as JSON."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from stillmap.cli.console import print_json, print_lines

if TYPE_CHECKING:
    from stillmap.cli.eval_scores import Scores

_TRAJECTORY = "rows 't x y theta' or TUM rows 'stamp x y z qx qy qz qw'"

_MAX_DT_RELATIONS = 0.1  # s between a relation's time and a pose, as in the authors' program
_MAX_DT_TRAJECTORY = 0.02  # s between the stamps of two systems for one scan

DESCRIPTION = (
    "Score a result, as text or with --json as one object on stdout. `relations` "
    "and `trajectory` compare poses with a reference; `labels` and `map` compare a "
    "result with the truth that `stillmap simulate` writes."
)
EPILOG = """examples:
  stillmap eval relations out/trajectory.tum log.relations
  stillmap eval trajectory out/trajectory.tum truth.tum --json
  stillmap eval labels out sim
  stillmap eval map out sim
"""


# help, description and arguments of examples
_SCORES = {
    "relations": (
        "known displacements between pairs of poses",
        "Errors of known displacements between pairs of poses (Kuemmerle et al. 2009).",
        "out/trajectory.tum log.relations",
        "out/trajectory.tum log.relations --odom log.clf.gz --json",
    ),
    "trajectory": (
        "absolute and relative errors against a reference",
        "Absolute and relative errors of a trajectory against a reference (ATE, RPE).",
        "out/trajectory.tum sim/truth/trajectory.tum",
        "out/trajectory.tum truth.tum --delta 10 --delta-unit frames",
    ),
    "labels": (
        "P(static) of the beams, against a simulation's truth",
        "Classification of beams against a simulation's truth; dynamic is the positive class.",
        "out sim",
        "out sim --json",
    ),
    "map": (
        "ghost cells and walls kept, against a simulation's truth",
        "Occupied cells where nothing static is, and the share of wall cells that the map shows, "
        "against a simulation's truth.",
        "out sim",
        "out sim --reference out-empty --reference-truth sim-empty",
    ),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the four scores."""
    scores = parser.add_subparsers(title="scores", dest="score", required=True, metavar="SCORE")
    for name, (about, description, *examples) in _SCORES.items():
        epilog = "\n".join(
            ["examples:", *(f"  stillmap eval {name} {one}" for one in examples), ""]
        )
        score = scores.add_parser(name, help=about, description=description, epilog=epilog)
        if name == "relations":
            _add_relations(score)
        elif name == "trajectory":
            _add_trajectory(score)
        else:
            _add_simulation(score, name)
        score.add_argument("--json", action="store_true", help="one JSON object on stdout")


def _add_relations(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("trajectory", type=Path, metavar="TRAJ", help=_TRAJECTORY)
    parser.add_argument(
        "relations", type=Path, metavar="RELATIONS", help="rows 't1 t2 x y z roll pitch yaw'"
    )
    parser.add_argument(
        "--odom",
        type=Path,
        metavar="FILE",
        help="CARMEN log (.gz too) or trajectory for times without a pose near them",
    )
    parser.add_argument(
        "--max-dt",
        type=_seconds,
        default=_MAX_DT_RELATIONS,
        metavar="S",
        help="largest distance from a time to its pose, seconds (default: %(default)s)",
    )
    parser.add_argument(
        "--compose",
        action="store_true",
        help="error as the displacement between both, not as difference of components",
    )


def _add_trajectory(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("trajectory", type=Path, metavar="TRAJ", help=_TRAJECTORY)
    parser.add_argument("reference", type=Path, metavar="REFERENCE", help=_TRAJECTORY)
    parser.add_argument(
        "--max-dt",
        type=_seconds,
        default=_MAX_DT_TRAJECTORY,
        metavar="S",
        help="largest distance of paired stamps, seconds (default: %(default)s)",
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


def _add_simulation(parser: argparse.ArgumentParser, score: str) -> None:
    """The arguments of scores against a simulation."""
    parser.add_argument(
        "result", type=Path, metavar="RESULT_DIR", help="folder that `stillmap map` wrote"
    )
    parser.add_argument(
        "truth", type=Path, metavar="TRUTH_DIR", help="folder that `stillmap simulate` wrote"
    )
    if score == "map":
        parser.add_argument(
            "--reference",
            type=Path,
            metavar="OTHER_RESULT_DIR",
            help="take the walls from this map, say of the same run without people "
            "(default: from true static hits)",
        )
        parser.add_argument(
            "--reference-truth",
            type=Path,
            metavar="DIR",
            help="truth of that other run (default: TRUTH_DIR)",
        )


def run(args: argparse.Namespace) -> int:
    """Compute and print one score.

    Raises:
        InputError: a file is missing, damaged, or does not match the others.
    """
    scores, lines = _compute_scores(args)
    if args.json:
        print_json(scores)
    else:
        print_lines(lines)
    return 0


def _compute_scores(args: argparse.Namespace) -> "Scores":
    from stillmap.cli import eval_scores

    if args.score == "relations":
        return eval_scores.score_relations(
            args.trajectory, args.relations, args.odom, args.max_dt, args.compose
        )
    if args.score == "trajectory":
        return eval_scores.score_trajectory(
            args.trajectory, args.reference, args.max_dt, args.delta, args.delta_unit
        )
    if args.score == "labels":
        return eval_scores.score_beam_labels(args.result, args.truth)
    return eval_scores.score_grid(args.result, args.truth, args.reference, args.reference_truth)


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
