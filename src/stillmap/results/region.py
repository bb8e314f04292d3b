"""Limits a result to the option `output.region`: poses and labels stay those of all scans."""

import dataclasses
from typing import Any, TypeVar

import numpy as np

from stillmap.core.errors import InputError
from stillmap.core.grid_map import GridMap, Region, is_inside
from stillmap.core.tiles import Block, cut
from stillmap.pipeline.result import MappingResult
from stillmap.pipeline.snapshots import extent
from stillmap.tracking import FlowMap, MovingObject

Some = TypeVar("Some", bound=MappingResult)
_MAP_LAYERS = ("p_occupied", "alpha", "beta")
_EVIDENCE_LAYERS = ("observations", "unobstructed", "thinly_observed")


def require_overlap(occupancy: GridMap, region: Region | None) -> None:
    """Refuse a region that shows nothing of a map.

    Raises:
        InputError: names the extent of the map.
    """
    if region is not None and _cells(occupancy, region) is None:
        x0, y0, x1, y1 = (f"{value:.2f}" for value in extent(occupancy))
        wanted = " ".join(f"{value:g}" for value in region)
        raise InputError(
            f"the region {wanted} lies outside the map",
            hint=f"the map spans {x0} to {x1} m in x, {y0} to {y1} m in y",
        )


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
        return dataclasses.replace(layers, **parts, **more)

    maps = dataclasses.replace(
        result.maps,
        filtered=crop(result.map, _MAP_LAYERS, origin=corner),
        raw=crop(result.raw_map, _MAP_LAYERS, origin=corner),
        evidence=crop(result.evidence, _EVIDENCE_LAYERS),
    )
    return dataclasses.replace(
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
    return dataclasses.replace(
        traffic, crossings=crossings, speed=speed, origin=_corner(traffic, block)
    )
