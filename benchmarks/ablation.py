"""Ablation of the default estimator: labels without each of its parts, at the same poses.

python benchmarks/ablation.py [--cases NAME|GROUP ...] [--seeds tuning|reporting] [--n-seeds 1]
    [--set section.key=value ...] [--true-poses] [--processes 2]

Poses are those of the whole estimator's result, so that only the E-step differs: that of the loop,
not the final one after it, which has more classes.
"""

import argparse
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from unittest.mock import patch

import numpy as np
from cases import EMPTY, POPULATED, STOPS
from common import (
    LASTING,
    Run,
    add_arguments,
    add_run_arguments,
    built,
    options_of,
    outcomes,
    runs_of,
)
from numpy.typing import NDArray
from prepared import RESOLUTION
from tables import markdown

from stillmap.core.recording import Recording
from stillmap.em import EmOptions, EStepResult, observations, occupancy_hmm
from stillmap.em.observations import LOOP_CLASSES, HmmClasses
from stillmap.eval.labels import LabelScores, score_labels
from stillmap.sim import simulate

_NONE = 1e-6  # scatters: as good as none; half a cell remains where noise is not the reason


@dataclass(frozen=True)
class Variant:
    """Constants of the observation model, options and classes that differ from the whole."""

    without: str
    constants: dict[str, float] = field(default_factory=dict)
    classes: HmmClasses = LOOP_CLASSES
    options: dict[str, float] = field(default_factory=dict)

    def e_step(
        self, recording: Recording, poses: NDArray[np.float64], options: EmOptions
    ) -> EStepResult:
        options = dataclasses.replace(options, **self.options)  # type: ignore[arg-type]
        with patch.multiple(
            observations, **(self.constants or {"_LATERAL": observations._LATERAL})
        ):
            return occupancy_hmm.e_step(recording, poses, RESOLUTION, options, 1, self.classes)


VARIANTS = (
    Variant("nothing: the whole"),
    Variant("surfaces: every element is round", {"_USE_NORMALS": False}),
    Variant("trust beside the beam: 3 scatters", {"_LATERAL": 3.0}),
    Variant("room behind the surface", {"_MARGIN": _NONE}),
    Variant("hits of neighbours", {"_HIT_RADIUS": _NONE}),
    Variant("time bins: every scan counts for itself", options={"time_bin": 0.01}),
    Variant("people who stay: tau 0.5 s only", {}, HmmClasses(dynamic_tau=(0.5,))),
    Variant("crowded places: rho 0.01 only", {}, HmmClasses(dynamic_rho=(0.01,))),
    Variant("walls that are missed: rho 0.998 only", {}, HmmClasses(static_rho=(0.998,))),
    Variant("a share that is missed for seconds only", {}, HmmClasses(static_tau=(1.0,))),
)


def main() -> None:
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_arguments(p, [])
    add_run_arguments(p, [POPULATED, STOPS, EMPTY])
    args = p.parse_args()
    runs = runs_of(args, ["stillmap"])
    print(table([scores for _, scores in outcomes(scores_of, runs, args.processes)]))


def scores_of(run: Run) -> list[LabelScores]:
    """Of each variant, in the order of VARIANTS; beams on doors and things are left out."""
    sim = simulate(run.case.build(), run.seed)
    recording, truth = sim.recording, sim.truth
    options = options_of(run.method, run.settings)
    poses = truth.T_world_base if run.true_poses else built(recording, options)[0].poses
    kinds = np.array([*truth.scene["mover_kinds"], "none"])[truth.mover]
    scored = recording.hit & ~np.isin(kinds, LASTING)
    found = (v.e_step(recording, poses, options.em) for v in VARIANTS)
    return [score_labels(e.p_static, truth.static, scored) for e in found]


def table(runs: Sequence[Sequence[LabelScores]]) -> str:
    """Means over runs with movers, the worst F1, and what is called dynamic where nothing moves."""
    lines = []
    for variant, of_runs in zip(VARIANTS, zip(*runs, strict=True), strict=True):
        moving = [s for s in of_runs if s.dynamic]
        still = [s.share_called_dynamic for s in of_runs if not s.dynamic]
        names = ("f1", "average_precision", "brier", "log_loss", "ece_unsure")
        means = [float(np.mean([getattr(s, name) for s in moving])) for name in names]
        lines.append(
            [
                variant.without,
                f"{means[0]:.4f} ({min(s.f1 for s in moving):.4f})",
                *(f"{mean:.4f}" for mean in means[1:4]),
                f"{means[4]:.3f}",
                f"{100 * max(still):.3f} %" if still else "-",
            ]
        )
    header = ["without", "F1 (worst)", "AP", "Brier", "log loss", "ECE unsure"]
    return markdown([*header, "called dynamic where nothing moves, worst"], lines)


if __name__ == "__main__":
    main()
