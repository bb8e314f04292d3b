"""Options of rigs with a planar and a tilting laser."""

from dataclasses import dataclass

from stillmap.core.config import Section, option


@dataclass(frozen=True)
class RigOptions(Section, section="rig"):
    """A second laser that builds in 3D; see docs/rig.md."""

    margin: float = option(
        0.15,
        "Margin in metres around the box of a moving object within which points of the second "
        "laser are probably dynamic.",
        ge=0,
        le=10,
    )
