"""All options of a run, and their resolution for a recording."""

import dataclasses
from dataclasses import dataclass, field
from typing import Literal

from stillmap.core.config import Section, option
from stillmap.core.recording import Recording
from stillmap.em import EmOptions
from stillmap.em.options import MapState
from stillmap.io.cameras import depth_camera_names
from stillmap.mesh.options import MeshOptions
from stillmap.preprocessing.options import ReadOptions
from stillmap.rig.options import RigOptions
from stillmap.slam import SlamOptions
from stillmap.tracking import ObjectOptions

MapMode = Literal["trinary", "scale", "raw"]


@dataclass(frozen=True)
class OutputOptions(Section, section="output"):
    """How the result folder is written."""

    map_mode: MapMode = option(
        "trinary",
        "pixels of the map picture: trinary (occupied, unknown, free), scale (grey between the "
        "thresholds; a .png, as unknown needs transparency) or raw (percent occupied, 255 unknown)",
    )
    map_state: MapState = option(
        "last", "of places that changed the map shows the last state, or the one held for longest"
    )
    min_obstacle_height: float = option(
        0.2,
        "Lowest height above the ground, in metres, that counts as an obstacle in the 2D map of 3D "
        "recordings.",
        ge=0.0,
    )
    max_obstacle_height: float = option(
        1.8, "Greatest height above the ground, in metres, that counts as an obstacle.", le=100.0
    )

    def check(self) -> None:
        """Refuses an empty band of heights."""
        if not self.min_obstacle_height < self.max_obstacle_height:
            raise ValueError(
                "'output.min_obstacle_height' must be less than 'output.max_obstacle_height'"
            )


@dataclass(frozen=True)
class Options(Section):
    """All options of a run."""

    threads: int = option(
        0,
        "Number of threads; 0 uses every core. The result does not depend on it.",
        ge=0,
        le=1024,
    )
    # spelled out: ruff takes the default for mutable under an alias
    estimator: Literal["stillmap", "paper", "hit-ratio", "tracker"] = option(
        "stillmap",
        "what says which beams are static; paper: (8) as printed, hit-ratio: counting, "
        "tracker: all that are not on people who are tracked",
    )
    read: ReadOptions = field(default=ReadOptions())
    em: EmOptions = field(default=EmOptions())
    slam: SlamOptions = field(default=SlamOptions())
    objects: ObjectOptions = field(default=ObjectOptions())
    rig: RigOptions = field(default=RigOptions())
    mesh: MeshOptions = field(default=MeshOptions())
    output: OutputOptions = field(default=OutputOptions())


DEFAULTS = Options()

# m, edges of voxels; depth cameras see people from near by, and within few of the larger ones
_VOXEL, _OF_DEPTH = 0.15, 0.05


def resolved(options: Options, recording: Recording) -> Options:
    """The options as they will be used.

    The printed method has poses by (9) alone, scan by scan, and takes scans as taken at once. The
    cells of 3D recordings are voxels.
    """
    if recording.dimension == 3:
        voxel = options.slam.voxel_size or (
            _OF_DEPTH if depth_camera_names(recording.source) else _VOXEL
        )
        slam_options = dataclasses.replace(options.slam, voxel_size=voxel, resolution=voxel)
        options = dataclasses.replace(options, slam=slam_options)
    if options.estimator != "paper":
        return options
    slam_options = dataclasses.replace(options.slam, loop_closure=False, deskew=False)
    return dataclasses.replace(options, slam=slam_options)
