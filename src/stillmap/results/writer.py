"""The result folder: every file of a run, limited to a region, appearing together or not at all."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_folder import write_arrays
from stillmap.core.array_types import Float32
from stillmap.core.errors import InputError
from stillmap.core.files import atomic_folder, write_text
from stillmap.core.grid_map import GridMap, Region, is_inside, limit_hits
from stillmap.core.json import write_json
from stillmap.core.recording import Recording
from stillmap.core.tiles import Block, cut
from stillmap.io.trajectory import write_tum
from stillmap.pipeline.result import MappingResult
from stillmap.pipeline.snapshots import extent
from stillmap.pipeline.tilting import TiltingResult
from stillmap.results.map_server import write_map_npz, write_map_server
from stillmap.results.objects import write_objects, write_traffic
from stillmap.results.point_cloud import write_clouds
from stillmap.results.pose_graph_g2o import write_g2o
from stillmap.results.reader import RECORD, TILTING
from stillmap.results.report.page import render_report
from stillmap.results.run_json import models_record, run_record, tilting_record
from stillmap.tracking import FlowMap, MovingObject

if TYPE_CHECKING:
    from stillmap.mesh.build import Models

Some = TypeVar("Some", bound=MappingResult)
_MAP_LAYERS = ("p_occupied", "alpha", "beta")
_EVIDENCE_LAYERS = ("observations", "unobstructed", "thinly_observed")


def save(
    result: MappingResult,
    path: Path,
    overwrite: bool = False,
    *,
    marker: str = RECORD,
    tilting: TiltingResult | None = None,
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
    colors = None if models is None else models.point_colors
    with atomic_folder(path, marker, overwrite) as folder:
        write_map_server(folder, result.map, result.options.output.map_mode)
        write_map_npz(folder / "map.npz", result.map, result.changes, result.evidence)
        write_tum(folder / "trajectory.tum", result.recording.stamp_ns, result.poses)
        if result.graph is not None:
            write_g2o(folder / "graph.g2o", result.graph, result.poses)
        is_3d = result.recording.dimension == 3
        write_labels(folder / "beams", result.recording, result.p_static, colors if is_3d else None)
        for one in (result if is_3d else None, tilting):
            if one is not None:
                seen = limit_hits(one.deskewed, one.poses, region)
                write_clouds(folder, seen, one.poses, one.p_static, colors, result.origin)
        if result.options.objects.enabled:
            write_objects(folder / "objects", result)
            write_traffic(folder / "traffic.npz", result.traffic)
        more = {}
        if tilting is not None:
            _write_tilting(folder / TILTING, tilting, colors, region)
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
    folder: Path, recording: Recording, p_static: Float32, colors: NDArray[np.uint8] | None = None
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
    folder: Path, tilting: TiltingResult, colors: NDArray[np.uint8] | None, region: Region | None
) -> None:
    """Write labels, poses and objects in 3D into a new folder."""
    folder.mkdir()
    write_labels(folder / "beams", tilting.recording, tilting.p_static, colors)
    write_tum(folder / "trajectory.tum", tilting.recording.stamp_ns, tilting.poses)
    objects = [one for one in tilting.objects if passes(one, region)]
    write_objects(folder / "objects", replace(tilting, objects=objects))


def require_overlap(occupancy: GridMap, region: Region | None) -> None:
    """Refuse a region that shows nothing of a map.

    Raises:
        InputError: names the extent of the map.
    """
    if region is not None and _cells(occupancy, region) is None:
        x0, y0, x1, y1 = (f"{value:.2f}" for value in extent(occupancy))
        wanted = " ".join(f"{value:g}" for value in region)
        hint = f"the map spans {x0} to {x1} m in x, {y0} to {y1} m in y"
        raise InputError(f"the region {wanted} lies outside the map", hint=hint)


def passes(one: MovingObject, region: Region | None) -> bool:
    """True if an object was in a region at any time; true without a region."""
    return region is None or bool(is_inside(one.xy, region).any())


def crop_result(result: Some) -> Some:
    """The maps, changes, objects and traffic in the region of the options; all without one.

    Raises:
        InputError: the region lies outside the map.
    """
    region = result.options.output.region
    if region is None:
        return result
    require_overlap(result.map, region)
    block = _cells(result.map, region)
    assert block is not None
    scratch, corner = result.recording.scratch, _corner(result.map, block)

    def crop(layers: Any, names: tuple[str, ...], **more: Any) -> Any:
        parts = {name: cut(getattr(layers, name), block, scratch) for name in names}
        return replace(layers, **parts, **more)

    maps = replace(
        result.maps,
        filtered=crop(result.map, _MAP_LAYERS, origin=corner),
        raw=crop(result.raw_map, _MAP_LAYERS, origin=corner),
        evidence=crop(result.evidence, _EVIDENCE_LAYERS),
    )
    return replace(
        result,
        maps=maps,
        changes=[one for one in result.changes if is_inside(np.array([one.x, one.y]), region)],
        doors=[one for one in result.doors if is_inside(np.array(one.hinge), region)],
        objects=[one for one in result.objects if passes(one, region)],
        traffic=_crop_traffic(result.traffic, region),
    )


def _cells(occupancy: GridMap | FlowMap, region: Region) -> Block | None:
    """Rows and columns of the cells that a region overlaps; None: none."""
    layer = occupancy.crossings if isinstance(occupancy, FlowMap) else occupancy.p_occupied
    size, corner = occupancy.resolution, np.array(occupancy.origin[:2])
    # a limit on the edge of a cell, as map.yaml has them, is not to take in the next cell
    first = np.floor((np.array(region[:2]) - corner) / size + 1e-6).astype(int)
    last = np.ceil((np.array(region[2:]) - corner) / size - 1e-6).astype(int)
    first, last = np.maximum(first, 0), np.minimum(last, layer.shape[::-1])
    if (first >= last).any():
        return None
    return slice(int(first[1]), int(last[1])), slice(int(first[0]), int(last[0]))


def _corner(occupancy: GridMap | FlowMap, block: Block) -> tuple[float, float, float]:
    """The origin of the cells of a block."""
    x, y, yaw = occupancy.origin
    rows, columns = block
    return x + columns.start * occupancy.resolution, y + rows.start * occupancy.resolution, yaw


def _crop_traffic(traffic: FlowMap, region: Region) -> FlowMap:
    block = _cells(traffic, region) or (slice(0, 0), slice(0, 0))
    crossings, speed = traffic.crossings[block], traffic.speed[block]
    return replace(traffic, crossings=crossings, speed=speed, origin=_corner(traffic, block))
