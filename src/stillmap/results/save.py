"""The result folder: every file of a run, appearing together or not at all.

`run.json`: what was run, on what, with which options, and how it went.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from stillmap.core.config import to_dict
from stillmap.core.files import atomic_folder
from stillmap.core.json import count_skipped, to_jsonable
from stillmap.core.parallel import resolve_threads
from stillmap.core.version import package_version
from stillmap.io.trajectory import write_tum
from stillmap.mapping import Change
from stillmap.mapping.beam_statistics import count_beams
from stillmap.mesh.build import Models
from stillmap.pipeline.estimate import IterationRecord
from stillmap.pipeline.result import MappingResult
from stillmap.results.labels import write_labels
from stillmap.results.map_npz import known_area, write_map_npz
from stillmap.results.map_server import write_map_server
from stillmap.results.object_models import models_record, write_models
from stillmap.results.objects import write_objects, write_traffic
from stillmap.results.points import write_clouds
from stillmap.results.pose_graph_g2o import write_g2o
from stillmap.results.report.page import write_report
from stillmap.results.report.previews import ModelPreviews, render_previews
from stillmap.results.rig import FOLDER as TILTING
from stillmap.results.rig import tilting_record, write_tilting
from stillmap.rig.build import TiltingResult
from stillmap.slam import LoopClosure

FORMAT_VERSION = 1

_MILLIMETRES = 3  # digits


def run_record(result: MappingResult, more: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """The content of `run.json` as JSON-able values; numbers that are not finite become None.

    `more` are further keys with what they hold.
    """
    counts = count_beams(result.recording, result.p_static)
    counts = {
        "scans": result.recording.n_scans,
        **{name: counts[name] for name in ("beams", "hits", "max_range", "unusable")},
        "skipped": count_skipped(result.recording.source),
    }
    record = {
        "format_version": FORMAT_VERSION,
        "version": package_version(),
        "input": result.recording.source,
        "options": to_dict(result.options),
        "iterations": [_iteration(it) for it in result.iterations],
        "converged": result.converged,
        "best_iteration": result.best_iteration,
        **{
            key: {name: stage.get(key) for name, stage in result.stages.items()}
            for key in ("seconds", "cpu_seconds", "peak_memory_bytes")
        },
        "counts": counts,
        "area": known_area(result),
        "warnings": list(result.warnings),
        "learned": result.learned,
        "doubts": {
            "odometry_disagrees": result.doubts.odometry_faults,
            "found_by_wider_search": result.doubts.widened,
            "carried_before": result.doubts.breaks,
            "beside_the_map_from": result.doubts.unconnected,
        },
        "changes": [_change(one) for one in result.changes],
        "loops": {
            "accepted": [_loop(one) for one in result.loops if not one.refused],
            "refused": [_loop(one) | {"why": one.refused} for one in result.loops if one.refused],
        },
        **(more or {}),
    }
    plain: dict[str, Any] = to_jsonable(record)
    return plain


RECORD = "run.json"  # every result has it


def write_run_json(
    path: Path, result: MappingResult, more: Mapping[str, Any] | None = None
) -> None:
    """Write `run_record` to `path`."""
    text = json.dumps(run_record(result, more), indent=2, ensure_ascii=False, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")


def _loop(one: LoopClosure) -> dict[str, Any]:
    return {"earlier": one.earlier, "later": one.later, "explained": one.explained}


def _change(one: Change) -> dict[str, Any]:
    return {
        "kind": one.kind,
        "x": round(one.x, _MILLIMETRES),
        "y": round(one.y, _MILLIMETRES),
        **({} if one.z is None else {"z": round(one.z, _MILLIMETRES)}),
        "size": [round(metres, _MILLIMETRES) for metres in one.size],
        "cells": len(one.cells),
        "before_ns": one.before_ns,
        "stamp_ns": one.stamp_ns,
        "last_ns": one.last_ns,
        "times": one.times,
    }


def _iteration(it: IterationRecord) -> dict[str, Any]:
    return {
        "number": it.number,
        "bound": it.bound,
        "expected_log_likelihood": it.expected_log_likelihood,
        "held_out_log_likelihood": it.held_out_log_likelihood,
        "changed_share": it.changed_share,
        "seconds": it.seconds,
    }


def save(
    result: MappingResult,
    path: Path,
    overwrite: bool = False,
    *,
    staging_folder: Path | None = None,
    tilting: TiltingResult | None = None,
    models: Models | None = None,
) -> None:
    """Write `result` as the folder `path`: map, trajectory, pose graph, labels, objects, report.

    Args:
        result: what the pipeline found.
        path: the folder; it must not exist or be empty unless `overwrite` is given.
        overwrite: replace an earlier result, once the new folder is whole.
        staging_folder: where the new folder is written until then; None: beside `path`.
        tilting: what a second laser built in 3D.
        models: of the place and of what moved; see `stillmap.models`.

    Raises:
        InputError: `path` is taken or cannot be written to.
    """
    colours = None if models is None or models.point_colors is None else models.point_colors.colors
    with atomic_folder(path, RECORD, overwrite, staging_folder=staging_folder) as folder:
        write_map_server(folder, result.map, result.options.output.map_mode)
        write_map_npz(folder / "map.npz", result.map, result.changes, result.evidence)
        write_tum(folder / "trajectory.tum", result.recording.stamp_ns, result.poses)
        if result.graph is not None:
            write_g2o(folder / "graph.g2o", result.graph, result.poses)
        in_space = result.recording.dimension == 3
        write_labels(
            folder / "beams", result.recording, result.p_static, colours if in_space else None
        )
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
            write_models(folder, models, count, result.options.mesh.texture_quality)
            more["models"] = models_record(models)
        write_run_json(folder / RECORD, result, more)


def _stills(models: Models, threads: int) -> ModelPreviews:
    """What the report shows of models."""
    return render_previews(
        models.textured,
        models.unfiltered,
        np.array([view.T_camera_map for view in models.views]).reshape(-1, 4, 4),
        {one.shape.id: one.textured for one in models.objects},
        resolve_threads(threads),
        models.left_out,
    )
