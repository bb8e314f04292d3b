"""All options of a run, and their resolution for a recording."""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from stillmap.core.config import CheckedOptions, option, override
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.em import EmOptions
from stillmap.em.options import MapState
from stillmap.mesh.options import MeshOptions
from stillmap.prepare.options import ReadOptions
from stillmap.slam import SlamOptions
from stillmap.tracking import ObjectOptions

MapMode = Literal["trinary", "scale", "raw"]


@dataclass(frozen=True)
class OutputOptions(CheckedOptions):
    """Options of the result folder."""

    map_mode: MapMode = option(
        "trinary",
        "Pixels of the map image: trinary (occupied, unknown, free), scale (grey levels; PNG with "
        "transparency) or raw (occupancy in percent, 255 unknown).",
    )
    map_state: MapState = option(
        "last",
        "State of changed places shown in the map: the last one, or the one held longest "
        "(majority); or the last one with all doors open or shut.",
    )
    min_obstacle_height: float = option(
        0.2, "Lowest height of obstacles above the ground in maps of 3D recordings, m.", ge=0.0
    )
    max_obstacle_height: float = option(1.8, "Greatest height of these, m.", le=100.0)
    region: tuple[float, float, float, float] | None = option(
        None,
        "Part of the map frame that is written: x0, y0, x1, y1 in metres; unset: everything. Poses "
        "and labels are of all scans.",
    )

    def __post_init__(self) -> None:
        """Refuses an empty band of heights, and an empty region."""
        super().__post_init__()
        x0, y0, x1, y1 = self.region or (0.0, 0.0, 1.0, 1.0)
        if not (-math.inf < x0 < x1 < math.inf and -math.inf < y0 < y1 < math.inf):
            corners = f"{x0:g} {y0:g} {x1:g} {y1:g}"
            what = "'output.region' must be x0 y0 x1 y1 with x0 < x1 and y0 < y1"
            raise ValueError(f"{what}, got {corners}")
        if not self.min_obstacle_height < self.max_obstacle_height:
            what = "'output.min_obstacle_height' must be less than 'output.max_obstacle_height'"
            raise ValueError(what)


@dataclass(frozen=True)
class Options(CheckedOptions):
    """All options of a run."""

    threads: int = option(
        0, "Number of threads; 0 uses every core. The result does not depend on it.", ge=0, le=1024
    )
    # spelled out: ruff takes the default for mutable under an alias
    estimator: Literal["stillmap", "paper", "hit-ratio", "tracker"] = option(
        "stillmap",
        "How beams are labelled: stillmap (occupancy HMM), paper (equation 8 as printed), "
        "hit-ratio (counting), or tracker (people tracking).",
    )
    read: ReadOptions = field(default=ReadOptions())
    em: EmOptions = field(default=EmOptions())
    slam: SlamOptions = field(default=SlamOptions())
    objects: ObjectOptions = field(default=ObjectOptions())
    mesh: MeshOptions = field(default=MeshOptions())
    output: OutputOptions = field(default=OutputOptions())


DEFAULTS = Options()

_VOXEL_SIZE = 0.15  # m
_DEPTH_VOXEL_SIZE = 0.05  # m, of depth cameras, which see people close by


def resolve_options(options: Options, recording: Recording) -> Options:
    """Options as a run uses them.

    Sets the voxel size of 3D recordings. The printed method estimates poses by (9) alone, scan by
    scan, and does not deskew.
    """
    if recording.dimension == 3:
        is_depth = recording.source.has_depth_camera
        options = resolve_resolution(options, 3, _DEPTH_VOXEL_SIZE if is_depth else _VOXEL_SIZE)
    if options.estimator == "paper":
        slam = dataclasses.replace(options.slam, loop_closure=False, deskew=False)
        options = dataclasses.replace(options, slam=slam)
    return options


def resolve_resolution(options: Options, dimension: int, default: float = _VOXEL_SIZE) -> Options:
    """Options whose `resolution` is the voxel size in 3D; default: m, where it is unset."""
    if dimension == 2:
        return options
    voxel = options.slam.voxel_size or default
    slam = dataclasses.replace(options.slam, voxel_size=voxel, resolution=voxel)
    return dataclasses.replace(options, slam=slam)


def adopt_cells(options: Options, what: str, edges: Mapping[str, float]) -> Options:
    """The options with the edges of the cells of a map that is to grow.

    Args:
        options: see Options.
        what: the map, in messages.
        edges: m, by the names of the options of `slam`.

    Raises:
        InputError: the options ask for others.
    """
    for name, edge in edges.items():
        given = getattr(options.slam, name)
        if given != getattr(DEFAULTS.slam, name) and not math.isclose(given, edge, rel_tol=1e-5):
            hint = f"it grows with slam.{name}={edge:g}"
            raise InputError(f"the {what} has cells of {edge:g} m", hint=hint)
    return override(options, {"slam": edges})
