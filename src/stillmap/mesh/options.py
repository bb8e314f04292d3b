"""Options of meshes."""

from dataclasses import dataclass

from stillmap.core.config import CheckedOptions, option


@dataclass(frozen=True)
class MeshOptions(CheckedOptions):
    """Meshes of 3D recordings: the static surface and the moving objects; see docs/mesh.md."""

    enabled: bool | None = option(
        None,
        "Build meshes of 3D recordings; unset: where there are usable pictures to texture them "
        "with.",
    )
    voxel_size: float | None = option(
        None, "Edge of a TSDF voxel, in metres; unset: from the point spacing.", ge=0.001, le=10.0
    )
    max_faces: int = option(
        200_000, "Maximum number of triangles of the mesh of the place.", ge=4, le=1_000_000_000
    )
    texture_size: int = option(4096, "Maximum edge of a texture page, in pixels.", ge=64, le=16384)
    texture_quality: int = option(
        90, "JPEG quality of texture pages; 0 writes lossless PNG.", ge=0, le=95
    )
    objects: bool = option(True, "Build meshes of the moving objects as well.")
