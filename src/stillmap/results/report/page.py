"""`report.html`: one self-contained page about a run, rendered from the Jinja2 templates beside."""

import functools
import itertools
import math
import os
import sys
from collections import Counter
from collections.abc import Mapping
from importlib.util import cache_from_source
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stillmap.core.config import iter_options
from stillmap.core.json import count_skipped, to_jsonable
from stillmap.core.version import package_version
from stillmap.mapping.beam_statistics import count_beams
from stillmap.pipeline.result import MappingResult
from stillmap.results.report.curves import curve_of
from stillmap.results.report.formatting import FILTERS
from stillmap.results.report.maps import (
    changes_data,
    draw_filtered_map,
    evolution_data,
    map_data,
)
from stillmap.results.report.objects import objects_data, rig_data
from stillmap.slam.mount_calibration import Parameter

if TYPE_CHECKING:
    from jinja2 import BytecodeCache, Environment

    from stillmap.results.report.previews import ModelPreviews
    from stillmap.rig.build import TiltingResult

_TEMPLATES = Path(__file__).parent / "templates"
# factor, unit and digits of what is calibrated
_CALIBRATION_UNITS = {
    "theta": (180.0 / math.pi, "°", 1),
    "x": (1.0, " m", 3),
    "y": (1.0, " m", 3),
    "scale": (1.0, "", 3),
    "rotation_gain": (1.0, "", 3),
    "latency": (1.0, " s", 3),
}
_MIN_DYNAMIC = 100  # dynamic returns below which the weights of dynamic classes mean little


def render_report(
    result: MappingResult,
    tilting: "TiltingResult | None" = None,
    previews: "ModelPreviews | None" = None,
) -> str:
    """The page, of a few megabytes at most: no script, no outside request, all images inline."""
    filtered = draw_filtered_map(result)
    data = {
        "run": _run_data(result),
        "maps": map_data(result, filtered),
        "changes": changes_data(result, filtered),
        "objects": objects_data(result, filtered),
        "rig": rig_data(tilting, filtered),
        "models": _models_data(previews),
        "fitted": fitted_data(result),
        "calibration": calibration_data(result),
        "convergence": convergence_data(result),
        "evolution": evolution_data(result),
        "source": _source_data(result),
        "stages": result.stages,
        "options": [(one.name, one.value) for one in iter_options(result.options)],
        "version": package_version(),
    }
    return environment().get_template("report.html.j2").render(data)


def _models_data(previews: "ModelPreviews | None") -> dict[str, Any] | None:
    """See `previews.models_data`, whose renderer is loaded only where there are models."""
    if previews is None:
        return None
    from stillmap.results.report.previews import models_data

    return models_data(previews)


@functools.cache
def environment() -> "Environment":
    """The templates with the filters of `formatting`; HTML in data is escaped."""
    # jinja2 is loaded only where a report is written
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    found = Environment(
        bytecode_cache=_bytecode_cache(),
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    found.filters.update(FILTERS)
    return found


def _bytecode_cache() -> "BytecodeCache | None":
    """Compiled templates, kept where Python keeps its modules; None: Python keeps none either.

    Compiling takes longer than rendering.
    """
    if sys.dont_write_bytecode:
        return None
    from jinja2 import FileSystemBytecodeCache

    folder = Path(cache_from_source(str(_TEMPLATES / "report.py"))).parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return FileSystemBytecodeCache(str(folder)) if os.access(folder, os.W_OK) else None


def _run_data(result: MappingResult) -> dict[str, Any]:
    """Title, headline figures and warnings."""
    source, stamps, stages = result.recording.source, result.recording.stamp_ns, result.stages
    path = str(source.get("path", ""))
    return {
        "name": Path(path).name or "recording",
        "path": path,
        "format": str(source.get("format", "")),
        "scans": result.recording.n_scans,
        "skipped": count_skipped(source),
        "beams": count_beams(result.recording, result.p_static),
        "duration": float(stamps[-1] - stamps[0]) / 1e9 if len(stamps) else 0.0,
        "seconds": sum(float(stage.get("seconds") or 0) for stage in stages.values()),
        "memory": max(
            (stage.get("peak_memory_bytes") or 0 for stage in stages.values()), default=0
        ),
        "iterations": len(result.iterations),
        "best": result.best_iteration,
        "converged": result.converged,
        "warnings": result.warnings,
        "estimator": result.options.estimator,
        "dimension": result.recording.dimension,
        "map_state": result.options.output.map_state,
    }


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
        "held_out": kept if kept is not None and math.isfinite(kept) else None,
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
        rows += [_calibration_row(f"{which}, {name}", name, one) for name, one in laser.items()]
    return rows + [
        _calibration_row(f"odometry, {name.replace('_', ' ')}", name, one)
        for name, one in found.odometry.items()
    ]


def _calibration_row(what: str, name: str, one: Parameter) -> tuple[str, str, str, str]:
    factor, unit, digits = _CALIBRATION_UNITS[name]
    nominal, value, std = (factor * v for v in (one.nominal, one.value, one.std))
    estimated = f"{value:.{digits}f} ± {std:.{digits}f}{unit}"
    used = "estimated" if one.significant else "recorded"
    return what, f"{nominal:.{digits}f}{unit}", estimated, used


def _source_data(result: MappingResult) -> dict[str, Any]:
    """The reader's notes on the recording, without empty entries."""
    source = to_jsonable(result.recording.source)
    skipped = {name: source.pop(name, None) or {} for name in ("skipped", "skipped_odometry")}
    return {
        "entries": {k: v for k, v in source.items() if v not in ({}, [], None)},
        **{
            name: sorted(reasons.items(), key=lambda item: -int(item[1]["count"]))
            for name, reasons in skipped.items()
        },
    }
