"""The front end of live mapping, in 2D and 3D: what registers the scans."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from stillmap.core.short_repr import ShortRepr
from stillmap.live.crowd import Crowd
from stillmap.live.local_map import Labeller, MappedScan
from stillmap.live.scan import ScanBeams

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Registration(ShortRepr):
    """A registered scan.

    Attributes:
        T: (D+1, D+1) pose of the base in the frame of the odometry by scans, which never jumps.
        covariance: of the pose against the local map: (3, 3) of x, y (axes of that frame) and
            heading, in 3D (6, 6) of translation and rotation.
        explained: share of the beams that the local map explains.
        drift: (3, 3) covariance that the step adds where the scan says nothing; in 3D 0.
        twist: (3,) or (6,) m/s and rad/s of the base in its own frame during the scan.
        is_slipping: odometry disagrees with the scans.
        is_blind: no beam met anything that the local map knows.
        is_carried: the scans contradict the local map, which begins anew.
        is_contradicted: the last ones do, or nothing of them is in it; not enough of them yet.
        has_odometry: the prior is that of odometry.
    """

    T: Float
    covariance: Float
    explained: float
    drift: Float
    twist: Float
    is_slipping: bool = False
    is_blind: bool = False
    is_carried: bool = False
    is_contradicted: bool = False
    has_odometry: bool = False


class FrontEnd(Protocol):
    """Registers scans as they arrive: `ScanOdometry` in 2D, `SweepOdometry` in 3D.

    Hits and priors are those of the registration in 2D or 3D.
    """

    crowd: Crowd
    local_map: Any
    left_behind: Any  # the local map before the robot was carried

    def predict(self, beams: ScanBeams, increment: Float | None, /) -> Any:
        """The prior of the next scan, given the increment (D+1, D+1) of odometry."""

    def select(self, beams: ScanBeams, prior: Any, /) -> Any:
        """The hits of a scan with weight 1."""

    def end_points(self, hits: Any, prior: Any, /) -> tuple[NDArray[np.float32], Float]:
        """(N, D) points of the hits in the base frame at the stamp, and its pose, as predicted."""

    def register(
        self, beams: ScanBeams, hits: Any, prior: Any, increment: Float | None, /
    ) -> Registration:
        """Register a scan, (9), by its hits with weights P(static)."""

    def add(
        self,
        beams: ScanBeams,
        e: NDArray[np.float32],
        recent: NDArray[np.float32],
        label: Labeller,
        /,
    ) -> MappedScan | None:
        """Add the last scan to the local map, unless it contradicts it; the scan if it is spaced.

        Args:
            beams: of the scan, as if taken at its stamp.
            e: (N,) P(static).
            recent: (N,) the same with the prior of what was only just seen, for the local map.
            label: labels an earlier scan again, after a second.
        """

    def enter(self, local_map: Any, T: Float, /) -> None:
        """Go on in another map, in whose frame the frame so far has the pose T."""

    def correct(self, local_map: Any, motion: Float, /) -> None:
        """Go on with a local map made anew, in 3D None, after the map has moved (D+1, D+1)."""
