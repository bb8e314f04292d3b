"""The report on the estimation: likelihood over the iterations, fitted parameters, calibration."""

import itertools
import math
from collections import Counter
from collections.abc import Mapping
from typing import Any

from stillmap.mapping.beam_statistics import count_beams
from stillmap.pipeline.result import MappingResult
from stillmap.results.report.curves import curve_of
from stillmap.slam.mount_calibration import Parameter

# factor, unit, digits and words of what is calibrated
_CALIBRATED = {
    "theta": (180.0 / math.pi, "°", 1, "direction"),
    "x": (1.0, " m", 3, "position ahead of the robot's centre"),
    "y": (1.0, " m", 3, "position left of the robot's centre"),
    "scale": (1.0, "", 3, "distance, as a factor"),
    "rotation_gain": (1.0, "", 3, "rotation, as a factor"),
    "latency": (1.0, " s", 3, "delay"),
}
_MIN_DYNAMIC = 100  # dynamic returns below which the weights of dynamic classes mean little


def convergence_data(result: MappingResult) -> dict[str, Any] | None:
    """Iterations, where the bound decreased, held-out score, loop closures."""
    iterations = result.iterations
    if not iterations:
        return None
    finite = [it for it in iterations if math.isfinite(it.bound)]
    held_out = {it.number: it.held_out_log_likelihood for it in iterations}
    kept = held_out.get(result.best_iteration)
    numbers = [it.number for it in iterations]
    curves = [
        curve_of(numbers, values, result.best_iteration)
        for values in (
            [it.expected_log_likelihood for it in iterations],
            [it.bound for it in iterations],
        )
    ]
    return {
        "iterations": [
            {
                "number": it.number,
                "likelihoods": (it.expected_log_likelihood, it.bound, it.held_out_log_likelihood),
                "changed": it.changed_share,
                "seconds": it.seconds,
            }
            for it in iterations
        ],
        # (iteration, relative decrease)
        "falls": [
            (after.number, (before.bound - after.bound) / max(abs(before.bound), 1e-300))
            for before, after in itertools.pairwise(finite)
            if after.bound < before.bound
        ],
        # how many times as likely a beam is with the map as without
        "gain": math.exp(min(kept, 700.0)) if kept is not None and math.isfinite(kept) else None,
        "loops": len(result.loops),
        "rejected": Counter(one.rejected for one in result.loops if one.rejected).most_common(),
        "curves": curves if len(iterations) > 1 else [],
    }


def fitted_data(result: MappingResult) -> dict[str, Any] | None:
    """Parameters that the estimator fitted to the recording; None where it fits none."""
    learned: Mapping[str, Any] = result.learned
    if not learned:
        return None
    dynamic = count_beams(result.recording, result.p_static)["dynamic"]
    return {
        "p_static": float(learned["p_static"]),
        "noise": float(learned["scatter"]),
        "changing": learned.get("changing") if result.recording.dimension == 3 else None,
        "dynamic": dynamic,
        "few": dynamic < _MIN_DYNAMIC,
        **{
            name: sorted((float(row["value"]), float(row["share"])) for row in learned[name])
            for name in ("static_occupied", "mover_seconds", "mover_occupied")
        },
    }


def calibration_data(result: MappingResult) -> list[tuple[str, str, str, str]]:
    """Rows of what the motion shows of mounts and odometry: what, recorded, estimated, used."""
    found, rows = result.calibration, []
    for k, laser in enumerate(found.lasers):
        which = "laser" if len(found.lasers) == 1 else f"laser {k + 1}"
        if found.upside_down[k]:
            rows.append((f"{which}, mounting", "upright", "upside down", "estimated"))
        rows += [_calibration_row(which, name, one) for name, one in laser.items()]
    return rows + [_calibration_row("odometry", name, one) for name, one in found.odometry.items()]


def _calibration_row(which: str, name: str, one: Parameter) -> tuple[str, str, str, str]:
    factor, unit, digits, what = _CALIBRATED[name]
    nominal, value, std = (factor * v for v in (one.nominal, one.value, one.std))
    estimated = f"{value:.{digits}f} ± {std:.{digits}f}{unit}"
    used = "estimated" if one.significant else "recorded"
    return f"{which}, {what}", f"{nominal:.{digits}f}{unit}", estimated, used
