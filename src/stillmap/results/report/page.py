"""`report.html` of a recording: what was mapped, from what, and how it went."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stillmap.core.config import iter_options
from stillmap.core.errors import split_advice
from stillmap.core.json import to_jsonable
from stillmap.mapping.beam_statistics import count_beams
from stillmap.pipeline.quality import describe_quality
from stillmap.pipeline.result import MappingResult
from stillmap.results.report.estimation import calibration_data, convergence_data, fitted_data
from stillmap.results.report.maps import (
    changes_data,
    draw_filtered_map,
    evolution_data,
    map_data,
    objects_data,
    rig_data,
)
from stillmap.results.report.point_view import points_data
from stillmap.results.report.template import render_page
from stillmap.results.run_json import models_record

if TYPE_CHECKING:
    from stillmap.mesh.build import Models
    from stillmap.pipeline.tilting import TiltingResult

# files beside the report that are linked where they exist, with their content
_FILES = {
    "map.pgm": "the map, for map_server and nav2",
    "map.png": "the map, for map_server and nav2",
    "map.yaml": "its resolution and origin",
    "map.npz": "probability of every cell, for NumPy",
    "trajectory.tum": "where the robot was at every scan",
    "graph.g2o": "pose graph, for g2o and GTSAM",
    "static.ply": "points that stand still, in 3D",
    "dynamic.ply": "points that moved, in 3D",
    "mesh.glb": "surface of the place, in 3D",
    "objects/objects.json": "moving objects and their tracks",
    "traffic.npz": "how often each square was crossed",
    "beams/p_static.npy": "probability of every beam to be static",
    "run.json": "record of this run",
}
_NO_MORE: Mapping[str, str] = {}


def render_report(
    result: MappingResult,
    tilting: "TiltingResult | None" = None,
    models: "Models | None" = None,
    folder: Path | None = None,
) -> str:
    """The page, of a few megabytes at most: no outside request, images and script inline.

    Args:
        result: the mapped recording.
        tilting: 3D data of a rig's second laser.
        models: of the place and of moving objects.
        folder: the result folder, to whose files the page links; None: no links.
    """
    figure = draw_filtered_map(result)
    data = {
        "result": result,
        "run": (run := _run_data(result)),
        "title": run["name"],
        "quality": [
            (name, getattr(result.quality, name), line)
            for name, line in describe_quality(result.quality).items()
        ],
        "files": files_data(folder),
        "maps": None if figure is None else map_data(result, *figure),
        "changes": None if figure is None else changes_data(result, figure[0]),
        "objects": None if figure is None else objects_data(result, *figure),
        "points": points_data(result, tilting),
        "rig": None if tilting is None else rig_data(tilting, figure and figure[0]),
        "models": None if models is None else _models_data(models),
        "fitted": fitted_data(result),
        "calibration": calibration_data(result),
        "convergence": convergence_data(result),
        "evolution": evolution_data(result),
        "source": _source_data(result),
        "stages": _stages_data(result),
        "options": [(one.name, one.value) for one in iter_options(result.options)],
    }
    return render_page(data)


def _models_data(models: "Models") -> dict[str, Any]:
    """The record of the models, and why no image could texture anything; see `models_record`."""
    record = models_record(models)
    pictures = record["pictures"]
    reasons = {**pictures["left_out"], "damaged": len(pictures["unread"])}
    listed = "; ".join(f"{count:,}: {why}" for why, count in reasons.items() if count)
    return {**record, "untextured_reason": "" if record["area_painted"] else listed}


def _run_data(result: MappingResult) -> dict[str, Any]:
    """Title, headline figures and warnings."""
    source, stamps, stages = result.recording.source, result.recording.stamp_ns, result.stages
    path = source.path or ""
    findings = [split_advice(text) for text in result.warnings]
    return {
        "name": Path(path).name or "recording",
        "path": path,
        "format": source.format or "",
        "beams": count_beams(result.recording, result.p_static),
        "duration": float(stamps[-1] - stamps[0]) / 1e9 if len(stamps) else 0.0,
        "seconds": sum(float(stage.get("seconds") or 0) for stage in stages.values()),
        "memory": max(
            (stage.get("peak_memory_bytes") or 0 for stage in stages.values()), default=0
        ),
        "warnings": [(what, todo) for what, todo in findings if todo],
        "notes": [what for what, todo in findings if not todo],
    }


def files_data(folder: Path | None, more: Mapping[str, str] = _NO_MORE) -> list[tuple[str, str]]:
    """Names, relative to the report, and content of the files that a result folder has.

    Args:
        folder: None: no files.
        more: names and content of files that only some results have, which come first.
    """
    if folder is None:
        return []
    known = {**more, **_FILES, **more}
    return [(name, what) for name, what in known.items() if (folder / name).is_file()]


def _stages_data(result: MappingResult) -> list[tuple[str, float, int]]:
    """Name, seconds and peak memory in bytes of each stage."""
    return [
        (
            name.replace("_", " "),
            float(stage.get("seconds") or 0),
            int(stage.get("peak_memory_bytes") or 0),
        )
        for name, stage in result.stages.items()
    ]


def _source_data(result: MappingResult) -> dict[str, Any]:
    """The reader's notes on the recording, without empty entries."""
    source = to_jsonable(result.recording.source.to_dict())
    skipped = {name: source.pop(name, None) or {} for name in ("skipped", "skipped_odometry")}
    source.pop("warnings", None)  # shown at the top
    return {
        "entries": {k: v for k, v in source.items() if v not in ({}, [], None)},
        **{
            name: sorted(reasons.items(), key=lambda item: -int(item[1]["count"]))
            for name, reasons in skipped.items()
        },
    }
