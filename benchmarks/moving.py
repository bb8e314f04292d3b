"""What moved, in simulated worlds: is every walker one object, are objects walkers, how fast?

python benchmarks/moving.py [--cases NAME|GROUP ...] [--seeds tuning|reporting] [--n-seeds 5]
    [--true-poses] [--set section.key=value ...] [--processes 2]

A walker counts for each time that he is seen for more than 3 s, with no gap above 2 s. He is one
object if it has more than half of his beams, no more than a fifth of them is with others, and no
more than a fifth of its own beams then is of anything else. A switch is a change of the object with
most of his beams. False objects have most beams on what is static. Traffic: Spearman's correlation
of how often squares of the known floor were crossed, with how often movers crossed them while they
were seen. Cost is the share of all CPU time of the job. Vehicles are scored like walkers.
"""

from dataclasses import asdict

import numpy as np
from cases import POPULATED
from common import VEHICLES, Run, Scores, options_of, rows_of
from numpy.typing import NDArray
from object_scores import (
    ObjectScores,
    compute_rank_correlation,
    compute_true_flow_map,
    find_sightings,
    score_objects,
)
from prepared import grid_of
from tables import Column, means_and_worst

from stillmap.core import se2
from stillmap.core.profiling import StageTimer
from stillmap.pipeline.result import MappingResult, map_recording
from stillmap.results.eval.trajectory import align
from stillmap.sim import Simulation, simulate
from stillmap.tracking import compute_flow_map

COLUMNS = (
    Column("sightings", "seen > 3 s", ".0f"),
    Column("whole", "one object, %", ".1f", True),
    Column("lost", "lost", ".0f"),
    Column("split", "split", ".0f"),
    Column("merged", "merged", ".0f"),
    Column("switches", "switches", ".0f"),
    Column("objects", "objects", ".0f"),
    Column("false_per_100_m", "false per 100 m", ".2f"),
    Column("speed_error", "speed off, m/s", ".3f"),
    Column("vehicles", "vehicles > 3 s", ".0f"),
    Column("vehicles_whole", "one object, %", ".1f", True),
    Column("vehicles_speed_error", "their speed off, m/s", ".3f"),
    Column("traffic", "traffic, 0.5 m", ".3f", True),
    Column("traffic_1_m", "1 m", ".3f", True),
    Column("cost", "cost, %", ".1f"),
)
_SEEN = 0.6  # s for which a mover must be seen to have crossed a square


def main() -> None:
    rows = rows_of(__doc__ or "", [POPULATED], _scored)
    print("Means over seeds, in brackets the worst.\n")
    print(means_and_worst(rows, COLUMNS))


def _scored(run: Run) -> Scores:
    simulation = simulate(run.case.build(), run.seed)
    stages = StageTimer()
    poses = simulation.truth.T_world_base if run.true_poses else None
    options = options_of("stillmap", run.settings)
    result = map_recording(simulation.recording, options, poses=poses, stages=stages)
    spent = {name: float(stage["cpu_seconds"]) for name, stage in stages.to_dict().items()}
    return {**scores_of(result, simulation), "cost": 100.0 * spent["objects"] / sum(spent.values())}


def scores_of(result: MappingResult, simulation: Simulation) -> Scores:
    """Scores of the objects and the traffic of one result."""
    truth, recording = simulation.truth, simulation.recording
    seconds = 1e-9 * (recording.stamp_ns - recording.stamp_ns[0])
    kinds = np.array(truth.scene["mover_kinds"], dtype=object)
    people = np.flatnonzero(kinds == "person").tolist()
    vehicles = np.flatnonzero(np.isin(kinds, VEHICLES)).tolist()
    found, driven = (
        score_objects(result.objects, truth.mover, truth.movers, recording.offset, seconds, some)
        for some in (people, vehicles)
    )
    way = np.linalg.norm(np.diff(truth.T_world_base[:, :2, 2], axis=0), axis=1).sum()
    return {
        **asdict(found),
        "whole": _share_whole(found),
        "vehicles": driven.sightings,
        "vehicles_whole": _share_whole(driven),
        "vehicles_speed_error": driven.speed_error,
        "false_per_100_m": 100.0 * found.false / way,
        "traffic": _of_traffic(result, simulation, seconds, 0.5),
        "traffic_1_m": _of_traffic(result, simulation, seconds, 1.0),
    }


def _share_whole(found: ObjectScores) -> float:
    """Percent of the sightings that are one object; NaN without any."""
    return 100.0 * found.whole / found.sightings if found.sightings else float("nan")


def _of_traffic(
    result: MappingResult, simulation: Simulation, seconds: NDArray[np.float64], size: float
) -> float:
    truth, recording = simulation.truth, simulation.recording
    T_map_world = se2.inverse(align(result.poses, truth.T_world_base))
    # things do not go anywhere
    everyone = [k for k, kind in enumerate(truth.scene["mover_kinds"]) if kind != "thing"]
    seen = find_sightings(truth.mover, recording.offset, seconds, everyone, _SEEN)
    true = compute_true_flow_map(seen, truth.movers, recording.stamp_ns, T_map_world, size)
    grid = grid_of(result.map)
    return compute_rank_correlation(
        compute_flow_map(result.objects, size), true, grid.centres(np.argwhere(grid.free))
    )


if __name__ == "__main__":
    main()
