"""Options of the EM loop and of the occupancy HMM."""

from dataclasses import dataclass
from typing import Literal

from stillmap.core.config import CheckedOptions, Count, option

# state of changed places in the map: the last one, or the one held longest
MapState = Literal["last", "majority", "open", "shut"]


@dataclass(frozen=True)
class EmOptions(CheckedOptions):
    """The EM loop (Fig. 2), the occupancy HMM, and the detection of changes."""

    prior: float = option(0.9, "Prior probability p(c = 1) that a beam is static.", gt=0.0, lt=1.0)
    max_iterations: Count = option(6, "Maximum number of EM iterations.", ge=1)
    tolerance: float = option(
        1e-3,
        "Stop when the held-out likelihood (without one, the bound) gains less than this per "
        "iteration, in nats per beam.",
        ge=0.0,
    )
    label_tolerance: float = option(
        0.005,
        "Stop when P(static) of fewer than this share of the hits changes by more than 0.1, or no "
        "scan is affected (estimator stillmap); 0: never.",
        ge=0.0,
        le=1.0,
    )
    patience: Count = option(1, "Stop after this many iterations without a gain.", ge=1)
    held_out: Count = option(
        20, "Leave every n-th scan out of the map and score the map with it; 0: none.", ge=0
    )
    time_bin: float = option(
        0.5,
        "Width of the time bins in seconds; beams of one cell within a bin count as one "
        "observation.",
        ge=0.01,
        le=3600.0,
    )
    change_detection: bool = option(
        True,
        "Detect places where something was put down, taken away or moved, and show one of their "
        "states in the map.",
    )
    change_detection_3d: bool = option(
        False, "List changes of 3D recordings as 3D boxes as well; takes more time and memory."
    )

    def __post_init__(self) -> None:
        """Checks that one held-out scan in n leaves others."""
        super().__post_init__()
        if self.held_out == 1:
            raise ValueError("'em.held_out' must be 0, or at least 2")
