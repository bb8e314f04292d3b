"""Options of rigs: a laser that lies flat tells another one what moves."""

from dataclasses import dataclass

from stillmap.core.config import option


@dataclass(frozen=True)
class RigOptions:
    """A second laser that builds in 3D while the flat one tells what moves; see docs/rig.md."""

    margin: float = option(0.15, "m around what the flat laser saw of a thing that moves")
    low: float = option(0.05, "m above the ground: what is lower is the floor itself")
    height: float = option(2.0, "m above the ground, up to where a thing reaches at most")
    long: float = option(1.5, "m, things at least so long may be higher: vehicles")
    tallest: float = option(4.0, "m above the ground, up to where these reach at most")
    gap: float = option(0.5, "m without any point: what is above belongs to something else")
    hold: float = option(
        0.5, "s for which a thing goes on before it is first seen and after it is last"
    )
    inside: float = option(
        0.99, "probability that what ends where the flat laser saw a thing is dynamic"
    )
    around: float = option(0.9, "the same within the margin around that")
    evidence: bool = option(
        True, "what the second laser itself saw to come and go counts beside the boxes"
    )
    voxel: float = option(0.1, "m, edge of the voxels of that")
    pause: float = option(
        1.0, "s between two scans of the flat laser, over which nobody knows where the robot was"
    )

    def __post_init__(self) -> None:
        for name in ("inside", "around"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise ValueError(f"'rig.{name}' wants a probability between 0 and 1, both excluded")
        if not 0.0 <= self.low < self.height <= self.tallest <= 100.0:
            raise ValueError("'rig' wants 0 <= low < height <= tallest <= 100 metres")
        for name, low, high in _LIMITS:
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"'rig.{name}' wants {low:g} to {high:g}")


_LIMITS = (
    ("margin", 0.0, 10.0),
    ("long", 0.0, 1000.0),
    ("gap", 0.01, 100.0),
    ("hold", 0.0, 1000.0),
    ("voxel", 0.01, 10.0),
    ("pause", 1e-3, 1e6),
)
