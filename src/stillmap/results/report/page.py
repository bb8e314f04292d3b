"""`report.html` of a recording: what was mapped, from what, and how it went."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from stillmap.core import config, errors, json
from stillmap.mapping.labelled_recording import count_beams
from stillmap.pipeline.quality import describe_quality
from stillmap.pipeline.result import MappingResult
from stillmap.pipeline.tilting import TiltingResult
from stillmap.results.report import estimation, maps, point_view, template
from stillmap.results.run_json import models_record, tilting_record

if TYPE_CHECKING:
    from stillmap.mesh.build import Models

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
}
_NO_MORE: Mapping[str, str] = {}


def render_report(
    result: MappingResult,
    tilting: TiltingResult | None = None,
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
    figure, recording = maps.draw_filtered_map(result), result.recording
    findings = [errors.split_advice(text) for text in result.warnings]
    data = {
        "result": result,
        "title": Path(recording.source.path or "").name or "recording",
        "source": json.to_jsonable(recording.source.to_dict()),
        "beams": count_beams(recording.hit, result.p_static),
        "seconds": 1e-9 * float(recording.stamp_ns[-1] - recording.stamp_ns[0]),
        "warnings": [(what, todo) for what, todo in findings if todo],
        "notes": [what for what, todo in findings if not todo],
        "quality": describe_quality(result.quality),
        "files": files_data(folder),
        "maps": figure and maps.map_data(result, *figure),
        "changes": figure and maps.changes_data(result, figure[0]),
        "objects": figure and maps.objects_data(result, *figure),
        "points": point_view.points_data(result, tilting),
        "rig": None if tilting is None else tilting_record(tilting),
        "rig_dynamic": figure and tilting and maps.draw_dynamic(tilting, figure[0]),
        "models": None if models is None else models_record(models),
        "calibration": estimation.calibration_data(result),
        "convergence": estimation.convergence_data(result),
        "evolution": maps.evolution_data(result),
        "options": [(one.name, one.value) for one in config.iter_options(result.options)],
    }
    return template.render_page(data)


def files_data(folder: Path | None, more: Mapping[str, str] = _NO_MORE) -> list[tuple[str, str]]:
    """Names, relative to the report, and content of the files that a result folder has.

    Args:
        folder: None: no files.
        more: names and content of files that only some results have, which come first.
    """
    if folder is None:
        return []
    known = {**more, **_FILES, **more}
    there = [(name, what) for name, what in known.items() if (folder / name).is_file()]
    return [*there, ("run.json", "record of this run")]  # which is written last
