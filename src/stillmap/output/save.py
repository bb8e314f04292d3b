"""The result folder: every file of a run, appearing together or not at all."""

from pathlib import Path

import numpy as np

from stillmap.output.atomic import new_folder
from stillmap.output.beams import write_beams
from stillmap.output.clouds import write_clouds
from stillmap.output.graph_g2o import write_g2o
from stillmap.output.map_npz import write_map_npz
from stillmap.output.map_server import write_map_server
from stillmap.output.model_protocols import ModelsLike
from stillmap.output.models import models_record, write_models
from stillmap.output.objects import write_objects, write_traffic
from stillmap.output.protocols import ResultLike, TiltingLike
from stillmap.output.report import write_report
from stillmap.output.report_model import Stills, stills_of
from stillmap.output.run_json import RECORD, write_run_json
from stillmap.output.tilting import FOLDER as TILTING
from stillmap.output.tilting import tilting_record, write_tilting
from stillmap.recording.tum import write_tum
from stillmap.threads import resolved_threads


def save(
    result: ResultLike,
    path: Path,
    overwrite: bool = False,
    *,
    within: Path | None = None,
    tilting: TiltingLike | None = None,
    models: ModelsLike | None = None,
) -> None:
    """Write `result` as the folder `path`: map, trajectory, pose graph, labels, objects, report.

    Args:
        result: what the pipeline found.
        path: the folder; it must not exist or be empty unless `overwrite` is given.
        overwrite: replace an earlier result, once the new folder is whole.
        within: where the new folder is made until then; None: beside `path`.
        tilting: what a second laser built in 3D.
        models: of the place and of what moved; see `stillmap.models`.

    Raises:
        InputError: `path` is taken or cannot be written to.
    """
    colours = None if models is None or models.tints is None else models.tints.colours
    with new_folder(path, RECORD, overwrite, within=within) as folder:
        write_map_server(folder, result.map, result.options.output.map_mode)
        write_map_npz(folder / "map.npz", result.map, result.changes, result.evidence)
        write_tum(folder / "trajectory.tum", result.recording.stamp_ns, result.poses)
        if result.graph is not None:
            write_g2o(folder / "graph.g2o", result.graph, result.poses)
        in_space = result.recording.dimension == 3
        write_beams(folder / "beams", result, colours if in_space else None)
        if in_space:
            write_clouds(folder, result.seen, result.poses, result.p_static, colours)
        if result.options.objects.enabled:
            write_objects(folder / "objects", result)
            write_traffic(folder / "traffic.npz", result.traffic)
        stills = None if models is None else _stills(models, result.options.threads)
        write_report(folder / "report.html", result, tilting, stills)
        more = {}
        if tilting is not None:
            write_tilting(folder, tilting, colours)
            more[TILTING] = tilting_record(tilting)
        if models is not None:
            images = (result if tilting is None else tilting).recording.images
            count = 0 if images is None else len(images)
            write_models(folder, models, count, result.options.mesh.texture)
            more["models"] = models_record(models)
        write_run_json(folder / RECORD, result, more)


def _stills(models: ModelsLike, threads: int) -> Stills:
    """What the report shows of models."""
    return stills_of(
        models.textured,
        models.unfiltered,
        np.array([view.T_camera_map for view in models.views]).reshape(-1, 4, 4),
        {one.shape.id: one.textured for one in models.movers},
        resolved_threads(threads),
        models.left_out,
    )
