"""The result folder: every file of a run, appearing together or not at all."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_folder import write_arrays
from stillmap.core.files import atomic_folder, write_text
from stillmap.core.grid_map import Region, limit_hits
from stillmap.core.json import write_json
from stillmap.core.recording import Recording
from stillmap.io.trajectory import write_tum
from stillmap.pipeline.result import MappingResult
from stillmap.results.map_server import write_map_npz, write_map_server
from stillmap.results.objects import write_objects, write_traffic
from stillmap.results.points import write_clouds
from stillmap.results.pose_graph_g2o import write_g2o
from stillmap.results.reader import RECORD, TILTING
from stillmap.results.region import crop_result, passes
from stillmap.results.report.page import render_report
from stillmap.results.run_json import models_record, run_record, tilting_record

if TYPE_CHECKING:
    from stillmap.mesh.build import Models
    from stillmap.pipeline.tilting import TiltingResult


def save(
    result: MappingResult,
    path: Path,
    overwrite: bool = False,
    *,
    marker: str = RECORD,
    tilting: "TiltingResult | None" = None,
    models: "Models | None" = None,
    write_more: Callable[[Path], None] | None = None,
) -> None:
    """Writes the folder `path`: map, trajectory, pose graph, labels, objects, report, meshes.

    Args:
        result: the mapped recording.
        path: the folder; it must not exist or be empty unless `overwrite` is given.
        overwrite: replace an earlier result once the new folder is complete.
        marker: glob of a file that every folder has which may be replaced.
        tilting: 3D data of a rig's second laser.
        models: meshes of the place and of the moving objects.
        write_more: called with the folder before it appears, to write other files into it.

    Raises:
        InputError: `path` is taken or cannot be written to, or the region of the options lies
            outside the map.
    """
    result, region = crop_result(result), result.options.output.region
    colors = None if models is None or models.point_colors is None else models.point_colors.colors
    with atomic_folder(path, marker, overwrite) as folder:
        write_map_server(folder, result.map, result.options.output.map_mode)
        write_map_npz(folder / "map.npz", result.map, result.changes, result.evidence)
        write_tum(folder / "trajectory.tum", result.recording.stamp_ns, result.poses)
        if result.graph is not None:
            write_g2o(folder / "graph.g2o", result.graph, result.poses)
        is_3d = result.recording.dimension == 3
        write_labels(folder / "beams", result.recording, result.p_static, colors if is_3d else None)
        if is_3d:
            seen = limit_hits(result.deskewed, result.poses, region)
            write_clouds(folder, seen, result.poses, result.p_static, colors, result.frame.origin)
        if result.options.objects.enabled:
            write_objects(folder / "objects", result)
            write_traffic(folder / "traffic.npz", result.traffic)
        more = {}
        if tilting is not None:
            _write_tilting(folder, tilting, colors, region, result.frame.origin)
            more[TILTING] = tilting_record(tilting)
        if models is not None:
            from stillmap.results.models import write_models

            images = (result if tilting is None else tilting).recording.images
            count = 0 if images is None else len(images)
            write_models(folder, models, count, result.options.mesh.texture_quality)
            more["models"] = models_record(models)
        write_text(folder / "report.html", render_report(result, tilting, models, folder))
        if write_more is not None:
            write_more(folder)
        write_json(folder / RECORD, run_record(result, more), indent=2)


def write_labels(
    folder: Path,
    recording: Recording,
    p_static: NDArray[np.float32],
    colors: NDArray[np.uint8] | None = None,
) -> None:
    """Writes `stamp_ns`, `offset`, `p_static` and `hit` as .npy files into the new `folder`.

    Args:
        folder: `beams/` of a result; it is made.
        recording: T scans with M beams.
        p_static: (M,) P(c = 1).
        colors: (M, 3) of the end points, written as `colour`; None: without.

    Raises:
        ValueError: labels of another number of beams.
    """
    if p_static.shape != (recording.n_beams,):
        raise ValueError(f"p_static: expected ({recording.n_beams},), got {p_static.shape}")
    folder.mkdir()
    arrays: dict[str, NDArray[Any] | None] = {
        "stamp_ns": np.asarray(recording.stamp_ns, np.int64),
        "offset": np.asarray(recording.offset, np.int64),
        "p_static": np.asarray(p_static, np.float32),
        "hit": np.asarray(recording.hit, np.bool_),
        "colour": colors,
    }
    write_arrays(folder, arrays)


def _write_tilting(
    folder: Path,
    tilting: "TiltingResult",
    colors: NDArray[np.uint8] | None,
    region: Region | None,
    origin: NDArray[np.float64],
) -> None:
    """Write `static.ply`, `dynamic.ply` and `tilting/`: labels, poses and objects in 3D."""
    seen = limit_hits(tilting.deskewed, tilting.poses, region)
    write_clouds(folder, seen, tilting.poses, tilting.p_static, colors, origin)
    objects = [one for one in tilting.objects if passes(one, region)]
    tilting = replace(tilting, objects=objects)
    inside = folder / TILTING
    inside.mkdir()
    write_labels(inside / "beams", tilting.recording, tilting.p_static, colors)
    write_tum(inside / "trajectory.tum", tilting.recording.stamp_ns, tilting.poses)
    write_objects(inside / "objects", tilting)
