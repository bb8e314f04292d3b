"""The summary that `stillmap map` prints."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stillmap.cli.console import list_files, say
from stillmap.core.advice import split_advice

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from stillmap.core.recording import Recording
    from stillmap.mesh.build import Models
    from stillmap.pipeline.result import MappingResult
    from stillmap.rig.build import TiltingResult

_IN_SUMMARY = ("version", "converged", "best_iteration", "counts", "area", "seconds", "warnings")


def summarize(output: Path) -> dict[str, Any]:
    """The main entries of `run.json`, and the files of the result."""
    from stillmap.results.run_record import read_record

    record = read_record(output)
    return {
        "output": str(output),
        "files": list_files(output),
        "iterations": len(record["iterations"]),
        **{key: record[key] for key in (*_IN_SUMMARY, "tilting") if key in record},
    }


def _describe_quality(result: "MappingResult") -> list[str]:
    """One line; none where quality cannot be told."""
    quality = result.quality
    parts = {"labels": quality.labels, "geometry": quality.geometry}
    told = [f"{name} {value:.0f}" for name, value in parts.items() if value is not None]
    if quality.overall is None:
        return []
    return [f"quality {quality.overall:.0f} of 100: {', '.join(told)}"]


def print_summary(
    result: "MappingResult", tilting: "TiltingResult | None", models: "Models | None", output: Path
) -> None:
    lines = [
        f"{result.recording.n_scans} scans, {_describe_hits(result.recording, result.p_static)}",
        _describe_iterations(result),
        *_describe_quality(result),
        *_describe_changes(result),
        *([] if tilting is None else [_describe_tilting(tilting)]),
        *(f"{_kind_of(warning)}: {warning}" for warning in result.warnings),
        *_describe_lack_of_models(result, tilting, models),
        f"wrote {output}: open {output / 'report.html'}",
        f"see it over time: stillmap view {shlex.quote(str(output))}",
    ]
    for line in lines:
        say(line)


def _describe_lack_of_models(
    result: "MappingResult", tilting: "TiltingResult | None", models: "Models | None"
) -> list[str]:
    """The flag that makes models of a 3D recording without pictures."""
    is_2d = tilting is None and result.recording.dimension == 2
    if is_2d or models is not None or result.options.mesh.enabled is not None:
        return []
    return ["no surface model: the recording has no pictures, --mesh makes a grey one"]


def _describe_iterations(result: "MappingResult") -> str:
    """The iteration that was kept, and whether the loop stopped by itself."""
    n = len(result.iterations)
    if n == 1 and result.converged:
        return "converged after one iteration"
    ending = "" if result.converged else ", which had not converged"
    return f"kept iteration {result.best_iteration} of {n}{ending}"


def _kind_of(warning: str) -> str:
    """`warning` where the user can do something, else `note`."""
    return "warning" if split_advice(warning)[1] else "note"


def _describe_changes(result: "MappingResult") -> list[str]:
    n, last = len(result.changes), result.options.output.map_state == "last"
    if not n:
        return []
    state = "in its last state" if last else "in the state that it was in for longest"
    return [f"{n} place{'s' * (n > 1)} changed, the map shows {'it' if n == 1 else 'each'} {state}"]


def _describe_hits(recording: "Recording", p_static: "NDArray[np.float32]") -> str:
    from stillmap.mapping.beam_statistics import count_beams

    counts = count_beams(recording, p_static)
    share = 100.0 * counts["dynamic"] / max(counts["hits"], 1)
    return f"{counts['hits']} beams that hit something, {share:.1f} % of them dynamic"


def _describe_tilting(tilting: "TiltingResult") -> str:
    out = f"in 3D {_describe_hits(tilting.deskewed, tilting.p_static)}"
    if tilting.unposed_beams:
        out += f"; {tilting.unposed_beams} left out: the robot's pose is not known there"
    return out
