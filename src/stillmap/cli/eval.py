"""Score a result, as text or with --json as one object on stdout. `relations` and `trajectory`
compare poses with a reference; `labels` and `map` compare a result with the truth that `stillmap
simulate` writes.

examples:
  stillmap eval relations out/trajectory.tum log.relations
  stillmap eval relations out/trajectory.tum log.relations --odom log.clf.gz --json
  stillmap eval trajectory out/trajectory.tum truth.tum --delta 10 --delta-unit frames
  stillmap eval labels out sim
  stillmap eval map out sim --reference out-empty --reference-truth sim-empty
"""

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from stillmap.cli.arguments import add_flags
from stillmap.cli.console import format_rows, print_json, print_lines
from stillmap.core.errors import InputError


def _score_relations(args: argparse.Namespace) -> dict[str, Any]:
    from stillmap.results.eval import readers
    from stillmap.results.eval.trajectory import compute_relation_errors

    errors = compute_relation_errors(
        readers.read_planar_trajectory(Path(args.trajectory)),
        readers.read_relations(Path(args.relations)),
        readers.read_odometry(Path(args.odom)) if args.odom else None,
        args.max_dt,
        args.compose,
    )
    if not errors.used:
        what = f"no relation has a pose of {args.trajectory} within {args.max_dt:g} s at both ends"
        hint = "other clocks? --odom reaches further"
        raise InputError(what, where=str(args.relations), hint=hint)
    return errors.to_dict()


def _score_trajectory(args: argparse.Namespace) -> dict[str, Any]:
    from stillmap.results.eval import readers, trajectory

    estimated = readers.read_trajectory(Path(args.trajectory))
    reference = readers.read_trajectory(Path(args.reference))
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
    from stillmap.results.eval.labels import score_labels
    from stillmap.results.eval.readers import read_truth, require_same_beams
    from stillmap.results.reader import is_place, read_labels, require_there

    result, truth_folder = Path(args.result), Path(args.truth)
    require_there(result, truth_folder)
    if is_place(result):
        hint = f"one of its sessions: stillmap eval labels {result}/sessions/NAME {truth_folder}"
        raise InputError("is a place of several recordings", where=str(result), hint=hint)
    labels = read_labels(result)
    truth = read_truth(truth_folder, labels)
    require_same_beams(labels, truth, result)
    return score_labels(labels.p_static, truth.static(), labels.hit & truth.recording.hit).to_dict()


def _score_map(args: argparse.Namespace) -> dict[str, Any]:
    import numpy as np

    from stillmap.core import se2
    from stillmap.core.array_types import Float
    from stillmap.core.grid_map import is_inside
    from stillmap.results.eval import map as maps
    from stillmap.results.eval.readers import Truth, read_truth
    from stillmap.results.eval.trajectory import align, planar, read_paired_poses
    from stillmap.results.folder import ResultFolder
    from stillmap.results.reader import is_result, moved, read_grid, read_run, require_there

    def align_result(result: Path, truth: Truth) -> Float:
        """T_world_map, whose map frame starts at the first pose."""
        poses, true_poses = read_paired_poses(result, truth)
        return align(planar(poses), true_poses)

    result, truth_folder = Path(args.result), Path(args.truth)
    others = [Path(given) for given in (args.reference, args.reference_truth) if given]
    require_there(result, truth_folder, *others)
    truth = read_truth(truth_folder)
    grid, walls = read_grid(result), truth.walls()
    T_world_map = align_result(result, truth)
    if args.reference is None:
        targets = maps.extract_wall_cells_from_hits(truth.static_hits(), walls, grid, T_world_map)
    else:
        other = read_truth(Path(args.reference_truth)) if args.reference_truth else truth
        T_world_other = align_result(Path(args.reference), other)
        targets = maps.extract_wall_cells(read_grid(Path(args.reference)), walls, T_world_other)
    record = read_run(result) if is_result(result) else {}
    region = ResultFolder(result, record).output_options.region
    if region is not None:
        targets = targets[is_inside(moved(se2.inverse(T_world_map), targets), region)]
    # things brought in that stay are not ghosts
    solid = np.concatenate([walls, truth.lasting()])
    return maps.score_map(grid, solid, targets, T_world_map).to_dict()


class _Score(NamedTuple):
    """A score: its flags, what computes it, what it is, and units that its names do not say."""

    flags: str
    compute: Callable[[argparse.Namespace], dict[str, Any]]
    about: str
    units: str | None = None


FLAGS = ""  # each score has its own
_TRAJECTORY = "rows 't x y theta' or TUM rows 'stamp x y z qx qy qz qw'"
_SIMULATION = """
result RESULT_DIR  folder that `stillmap map` wrote
truth TRUTH_DIR  folder that `stillmap simulate` wrote
"""
_SCORES = {
    "relations": _Score(
        f"""
trajectory TRAJ  {_TRAJECTORY}
relations RELATIONS  rows 't1 t2 x y z roll pitch yaw'
--odom FILE  CARMEN log (.gz too) or trajectory for times without a pose near them
--max-dt S = 0.1  largest distance from a time to its pose, seconds
--compose  error as the displacement between both, not as difference of components
""",
        _score_relations,
        "errors of known displacements between pairs of poses (Kuemmerle et al. 2009)",
        "m, deg, and their squares",
    ),
    "trajectory": _Score(
        f"""
trajectory TRAJ  {_TRAJECTORY}
reference REFERENCE  {_TRAJECTORY}
--max-dt S = 0.02  largest distance of paired stamps, seconds
--delta X = 1.0  relative errors between poses this far apart
--delta-unit {{m,frames}} = m  metres along the reference, or poses
""",
        _score_trajectory,
        "absolute and relative errors against a reference trajectory (ATE, RPE)",
        "m, deg",
    ),
    "labels": _Score(
        _SIMULATION,
        _score_labels,
        "P(static) of the beams against a simulation's truth; dynamic is the positive class",
    ),
    "map": _Score(
        f"""{_SIMULATION}
--reference OTHER_RESULT_DIR  take the walls from this map, say of the same run without people
  (default: from true static hits)
--reference-truth DIR  truth of that other run (default: TRUTH_DIR)
""",
        _score_map,
        "ghost cells, and the share of walls that the map shows, against a simulation's truth",
        "m, m2, rad (T world map: x, y, theta)",
    ),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the four scores."""
    scores = parser.add_subparsers(title="scores", dest="score", required=True, metavar="SCORE")
    for name, (flags, _, about, _) in _SCORES.items():
        score = scores.add_parser(name, help=about, description=f"Compute {about}.")
        add_flags(score, f"{flags}--json  one JSON object on stdout")


def run(args: argparse.Namespace) -> int:
    """Compute and print one score.

    Raises:
        InputError: a file is missing, damaged, or does not match the others.
    """
    for name, value in vars(args).items():
        least = 0.0 if name == "max_dt" else 1e-9
        if isinstance(value, float) and not least <= value < math.inf:
            flag = f"--{name.replace('_', '-')}"
            raise InputError(f"{flag} must be at least {least:g}, got {value:g}")
    score = _SCORES[args.score]
    values = score.compute(args)
    if args.json:
        print_json(values)
    else:
        print_lines(format_rows({**values, "units": score.units}))
    return 0
