"""`stillmap eval`: score trajectories, labels and maps, as text or as JSON."""

import argparse
from pathlib import Path

from stillmap.cli.console import print_json, print_rows

_TRAJECTORY = "rows 't x y theta' or TUM rows 'stamp x y z qx qy qz qw'"

DESCRIPTION = (
    "Score a result, as text or with --json as one object on stdout. `relations` "
    "and `trajectory` compare poses with a reference; `labels` and `map` compare a "
    "result with the truth that `stillmap simulate` writes."
)
EPILOG = """examples:
  stillmap eval relations out/trajectory.tum log.relations
  stillmap eval relations out/trajectory.tum log.relations --odom log.clf.gz --json
  stillmap eval trajectory out/trajectory.tum truth.tum --delta 10 --delta-unit frames
  stillmap eval labels out sim
  stillmap eval map out sim --reference out-empty --reference-truth sim-empty
"""

_SCORES = {
    "relations": "errors of known displacements between pairs of poses (Kuemmerle et al. 2009)",
    "trajectory": "absolute and relative errors against a reference trajectory (ATE, RPE)",
    "labels": "P(static) of the beams against a simulation's truth; dynamic is the positive class",
    "map": "ghost cells, and the share of walls that the map shows, against a simulation's truth",
}

# what the names of the scores, unlike those of `stillmap info`, do not say
_UNITS = {
    "relations": "m, deg, and their squares",
    "trajectory": "m, deg",
    "map": "m, m2, rad (T world map: x, y, theta)",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the four scores."""
    scores = parser.add_subparsers(title="scores", dest="score", required=True, metavar="SCORE")
    add = {"relations": _add_relations, "trajectory": _add_trajectory, "map": _add_map}
    for name, about in _SCORES.items():
        score = scores.add_parser(name, help=about, description=f"Compute {about}.")
        add.get(name, _add_simulation)(score)
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
    # the default is that of the authors' program
    _add_max_dt(parser, 0.1, "largest distance from a time to its pose")
    parser.add_argument(
        "--compose",
        action="store_true",
        help="error as the displacement between both, not as difference of components",
    )


def _add_trajectory(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("trajectory", type=Path, metavar="TRAJ", help=_TRAJECTORY)
    parser.add_argument("reference", type=Path, metavar="REFERENCE", help=_TRAJECTORY)
    _add_max_dt(parser, 0.02, "largest distance of paired stamps")
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


def _add_max_dt(parser: argparse.ArgumentParser, default: float, about: str) -> None:
    text = f"{about}, seconds (default: %(default)s)"
    parser.add_argument("--max-dt", type=_seconds, default=default, metavar="S", help=text)


def _add_simulation(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "result", type=Path, metavar="RESULT_DIR", help="folder that `stillmap map` wrote"
    )
    parser.add_argument(
        "truth", type=Path, metavar="TRUTH_DIR", help="folder that `stillmap simulate` wrote"
    )


def _add_map(parser: argparse.ArgumentParser) -> None:
    _add_simulation(parser)
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
    from stillmap.cli.eval_scores import SCORES

    scores = SCORES[args.score](args)
    if args.json:
        print_json(scores)
    else:
        print_rows({**scores, "units": _UNITS.get(args.score)})
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
