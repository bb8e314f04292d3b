"""`run.json`: the input, the resolved options, the iterations, counts, times and warnings."""

import dataclasses
import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from stillmap.core.array_folder import FORMAT_VERSION
from stillmap.core.array_types import Bool
from stillmap.core.files import package_version
from stillmap.core.grid_map import GridMap
from stillmap.core.json import to_jsonable
from stillmap.core.recording import Recording
from stillmap.core.tiles import tiles_of
from stillmap.mapping import Change, Door
from stillmap.mapping.labelled_recording import count_beams
from stillmap.pipeline.quality import Quality
from stillmap.pipeline.result import MappingResult
from stillmap.pipeline.tilting import TiltingResult
from stillmap.results.objects import MILLIMETRES
from stillmap.results.reader import LOCAL_ORIGIN
from stillmap.slam import LoopClosure
from stillmap.slam.mount_calibration import UPSIDE_DOWN, Calibration, Parameter

if TYPE_CHECKING:
    from stillmap.mesh.build import Models


def run_record(result: MappingResult, more: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """The content of `run.json` as JSON values; numbers that are not finite become None.

    Args:
        result: the mapped recording.
        more: further keys and their values.
    """
    counts = count_beams(result.recording.hit, result.p_static)
    record = {
        "format_version": FORMAT_VERSION,
        "version": package_version(),
        "input": result.recording.source.to_dict(),
        "options": dataclasses.asdict(result.options),
        "iterations": [dataclasses.asdict(it) for it in result.iterations],
        "converged": result.converged,
        "best_iteration": result.best_iteration,
        **{
            key: {name: stage.get(key) for name, stage in result.stages.items()}
            for key in ("seconds", "cpu_seconds", "peak_memory_bytes")
        },
        "counts": _counts(result.recording, counts),
        "area": {"known": known_area(result.map), "thin": thin_area(result)},
        "warnings": list(result.warnings),
        "quality": quality_record(result.quality),
        "learned": result.learned,
        **({LOCAL_ORIGIN: result.origin.tolist()} if result.origin.any() else {}),
        "calibration": _calibration(result.calibration),
        "doubts": _doubts(result),
        "changes": [_change(one) for one in result.changes],
        "doors": [_door(one) | {"p_moved": round(one.p_moved, 4)} for one in result.doors],
        "loops": {
            "accepted": [_loop(one) for one in result.loops if not one.rejected],
            "refused": [_loop(one) | {"why": one.rejected} for one in result.loops if one.rejected],
        },
        **(more or {}),
    }
    return dict(to_jsonable(record))


def _counts(recording: Recording, beams: Mapping[str, int], **more: int) -> dict[str, int]:
    counts = {name: beams[name] for name in ("beams", "hits", "max_range", "unusable")}
    skipped = recording.source.n_skipped
    return {"scans": recording.n_scans, **counts, **more, "skipped": skipped}


def _doubts(result: MappingResult) -> dict[str, Any]:
    doubts = result.doubts
    return {
        "odometry_disagrees": doubts.odometry_faults,
        "found_by_wider_search": doubts.widened,
        "carried_before": doubts.breaks,
        "ambiguous": doubts.ambiguous,
        "length_unknown": [
            {
                "first": one.first,
                "last": one.last,
                "metres": round(one.metres, MILLIMETRES),
                "std": round(one.std, MILLIMETRES),
            }
            for one in doubts.bare_stretches
        ],
    }


def quality_record(quality: Quality) -> dict[str, float | None]:
    """The `quality` entry of `run.json`."""
    return {name: getattr(quality, name) for name in ("overall", "labels", "geometry")}


def known_area(occupancy: GridMap) -> float:
    """m2 of a map of which beams tell something."""
    parts = tiles_of(occupancy.p_occupied)
    known = sum(int(np.count_nonzero(~np.isnan(part))) for _, part in parts)
    return round(float(occupancy.resolution) ** 2 * known, 6)


def thin_area(result: MappingResult) -> float:
    """m2 of the map that are known on thin evidence."""
    parts = tiles_of(result.evidence.thinly_observed)
    thin = sum(int(np.count_nonzero(part)) for _, part in parts)
    return round(float(result.map.resolution) ** 2 * thin, 6)


def tilting_record(tilting: TiltingResult) -> dict[str, Any]:
    """The `tilting` entry of `run.json`."""
    counts = count_beams(tilting.deskewed.hit, tilting.p_static)
    return {
        "input": tilting.recording.source.to_dict(),
        "counts": _counts(tilting.recording, counts, left_out=tilting.unposed_beams),
        "dynamic": counts["dynamic"],
        "boxes": tilting.boxes_hit,
        "objects": len(tilting.objects),
        "learned": tilting.learned,
    }


def models_record(models: "Models") -> dict[str, Any]:
    """The entry `models` of `run.json`."""
    place = models.assignment
    areas = place.mesh.areas()

    def area(of: Bool) -> float:
        return round(float(areas[of].sum()), 4)

    used = {view.image for k, view in enumerate(models.views) if (place.view == k).any()}
    return {
        "faces": len(areas),
        "area": area(np.ones(len(areas), np.bool_)),
        "area_seen": area(place.visible),
        "area_painted": area(place.view >= 0),
        "pictures": {
            "used": len(used),
            "usable": len(models.views),
            "left_out": dict(models.left_out),
            "unread": list(models.unread),
        },
        "pages": [list(page.shape[:2]) for page in models.textured.pages],
        "objects": {"found": models.n_objects, "modelled": len(models.objects)},
    }


def _calibration(found: Calibration) -> dict[str, Any]:
    return {
        "windows": found.windows,
        "lasers": [
            {**{name: _parameter(one) for name, one in laser.items()}, UPSIDE_DOWN: mirrored}
            for laser, mirrored in zip(found.lasers, found.upside_down, strict=True)
        ],
        "odometry": {name: _parameter(one) for name, one in found.odometry.items()},
    }


def _parameter(one: Parameter) -> dict[str, Any]:
    return {
        "recorded": one.nominal,
        "estimated": one.value,
        "std": one.std,
        "applied": one.significant,
    }


def read_calibration(record: Any) -> Calibration:
    """The `calibration` entry of a `run.json`; empty where there is none.

    Raises:
        TypeError, ValueError, KeyError, AttributeError: it is damaged.
    """
    if record is None:
        return Calibration()
    lasers = record["lasers"]
    return Calibration(
        [
            {name: _read_parameter(one) for name, one in laser.items() if name != UPSIDE_DOWN}
            for laser in lasers
        ],
        [bool(laser.get(UPSIDE_DOWN)) for laser in lasers],
        {name: _read_parameter(one) for name, one in record["odometry"].items()},
        int(record["windows"]),
    )


def _read_parameter(one: Mapping[str, Any]) -> Parameter:
    # a number that is not finite is written as None, and not applied
    numbers = (one["recorded"], one["estimated"], one["std"])
    recorded, estimated, std = (math.nan if n is None else float(n) for n in numbers)
    return Parameter(recorded, estimated, std, bool(one["applied"]))


def _loop(one: LoopClosure) -> dict[str, Any]:
    return {"earlier": one.earlier, "later": one.later, "explained": one.explained}


def _in_millimetres(metres: Iterable[float]) -> list[float]:
    return [round(length, MILLIMETRES) for length in metres]


def _change(one: Change) -> dict[str, Any]:
    center = (one.x, one.y) if one.z is None else (one.x, one.y, one.z)
    return {
        "kind": one.kind,
        **dict(zip("xyz", _in_millimetres(center), strict=False)),
        "size": _in_millimetres(one.size),
        "cells": len(one.cells),
        "before_ns": one.before_ns,
        "stamp_ns": one.stamp_ns,
        "last_ns": one.last_ns,
        "times": one.times,
        **({} if one.door is None else {"door": _door(one.door)}),
    }


def _door(door: Door) -> dict[str, Any]:
    return {
        "hinge": _in_millimetres(door.hinge),
        "length": round(door.length, MILLIMETRES),
        "shut": round(door.shut, MILLIMETRES),
        "open": round(door.opened, MILLIMETRES),
        "states": [one._asdict() for one in door.states],
    }
