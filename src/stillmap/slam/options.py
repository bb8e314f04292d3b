"""Options of the M-step over poses and map."""

from dataclasses import dataclass, field

from stillmap.core.config import CheckedOptions, option


@dataclass(frozen=True)
class OdometryOptions(CheckedOptions):
    """Noise of wheel odometry."""

    translation_per_metre: float = option(
        0.07, "Standard deviation of odometry translation per metre travelled.", ge=0, le=100
    )
    translation_per_radian: float = option(
        0.05, "Standard deviation of odometry translation per radian turned.", ge=0, le=100
    )
    rotation_per_metre: float = option(
        0.1, "Standard deviation of odometry heading per metre travelled.", ge=0, le=100
    )
    rotation_per_radian: float = option(
        0.3, "Standard deviation of odometry heading per radian turned.", ge=0, le=100
    )


@dataclass(frozen=True)
class SlamOptions(CheckedOptions):
    """Poses and map."""

    resolution: float = option(0.05, "Edge of a map cell, in metres.", ge=0.005, le=10)
    voxel_size: float | None = option(
        None,
        "Edge of a voxel of 3D recordings, in metres; unset: 0.15, or 0.05 for depth cameras.",
        ge=0.005,
        le=10,
    )
    deskew: bool = option(
        True, "Correct scans for the motion of the robot, where beams have times."
    )
    loop_closure: bool = option(
        True, "Close loops, in 2D and 3D; otherwise poses come from scan matching alone."
    )
    keyframe_distance: float | None = option(
        None, "Travel between keyframes, in metres; unset: 1 in 2D, 2 in 3D.", ge=0.05, le=100
    )
    loop_search_distance: float | None = option(
        None,
        "Maximum distance, in metres, between a keyframe and an earlier one for a loop closure; "
        "unset: 6 in 2D, 8 in 3D.",
        ge=0,
        le=100,
    )
    odometry: OdometryOptions = field(default=OdometryOptions())
