"""The course of the estimation: the likelihood over the iterations (Fig. 5), fitted values."""

import itertools
import math
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from stillmap.pipeline.result import MappingResult
from stillmap.results.report.figures import round_down
from stillmap.slam.mount_calibration import Parameter

WIDTH, HEIGHT = 460.0, 260.0  # of the view box
_LEFT, _RIGHT, _TOP, _BOTTOM = 92.0, 12.0, 10.0, 44.0  # margins of the axes
_MAX_TICKS_X = 10


def curve_of(numbers: Sequence[int], values: Sequence[float], best: int) -> dict[str, Any]:
    """A curve of `values` over iteration `numbers` in view box units, x to the right and y down.

    Returns:
        `box`: left, top, right and bottom edge of the axes; `lines`: `points` of the polylines, of
        which a value that is not finite ends one; `dots`: positions of the values; `best`: that of
        the kept iteration, None where its value is not finite; `x_ticks`, `y_ticks`: positions
        along the axis, with labels.
    """
    left, top, right, bottom = box = (_LEFT, _TOP, WIDTH - _RIGHT, HEIGHT - _BOTTOM)
    finite = [v for v in values if math.isfinite(v)] or [0.0]
    low, high = min(finite), max(finite)
    pad = 0.06 * (high - low) or max(1e-3 * abs(high), 1e-3)
    low, high = low - pad, high + pad
    x = np.interp(numbers, (numbers[0], max(numbers[-1], numbers[0] + 1)), (left + 8, right - 8))
    y = bottom - (np.array(values) - low) / (high - low) * (bottom - top)
    at = dict(zip(numbers, np.stack([x, y], axis=1).round(1).tolist(), strict=True))
    dots = {number: dot for number, dot in at.items() if math.isfinite(dot[1])}
    lines = [
        " ".join(f"{x},{y}" for x, y in (at[number] for number in run))
        for is_there, group in itertools.groupby(numbers, dots.__contains__)
        if is_there and len(run := list(group)) > 1
    ]
    step = round_down((high - low) / 3)
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    ticks = step * np.arange(math.ceil(low / step), math.floor(high / step) + 1)
    heights = bottom - (ticks - low) / (high - low) * (bottom - top)
    every = math.ceil(len(numbers) / _MAX_TICKS_X)
    return {
        "box": box,
        "lines": lines,
        "dots": list(dots.values()),
        "best": dots.get(best),
        "x_ticks": [(at[number][0], str(number)) for number in numbers[::every]],
        "y_ticks": [
            (y, f"{tick:,.{digits}f}")
            for y, tick in zip(heights.round(1).tolist(), ticks.tolist(), strict=True)
        ],
    }


# factor, unit, digits and words of what is calibrated
_CALIBRATED = {
    "theta": (180.0 / math.pi, "°", 1, "direction"),
    "x": (1.0, " m", 3, "position ahead of the robot's centre"),
    "y": (1.0, " m", 3, "position left of the robot's centre"),
    "scale": (1.0, "", 3, "distance, as a factor"),
    "rotation_gain": (1.0, "", 3, "rotation, as a factor"),
    "latency": (1.0, " s", 3, "delay"),
}


def convergence_data(result: MappingResult) -> dict[str, Any] | None:
    """Iterations, where the bound decreased, held-out score, loop closures."""
    iterations = result.iterations
    if not iterations:
        return None
    finite = [it for it in iterations if math.isfinite(it.bound)]
    best = [it for it in iterations if it.number == result.best_iteration]
    kept = best[0].held_out_log_likelihood if best else None
    numbers = [it.number for it in iterations]
    curves = [
        curve_of(numbers, values, result.best_iteration)
        for values in (
            [it.expected_log_likelihood for it in iterations],
            [it.bound for it in iterations],
        )
    ]
    return {
        # (iteration, relative decrease)
        "falls": [
            (after.number, (before.bound - after.bound) / max(abs(before.bound), 1e-300))
            for before, after in itertools.pairwise(finite)
            if after.bound < before.bound
        ],
        # how many times as likely a beam is with the map as without
        "gain": math.exp(min(kept, 700.0)) if kept is not None and math.isfinite(kept) else None,
        "rejected": Counter(one.rejected for one in result.loops if one.rejected).most_common(),
        "curves": curves if len(iterations) > 1 else [],
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
