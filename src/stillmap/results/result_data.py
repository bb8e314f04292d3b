"""The data that every result has, whether just built or loaded from its folder."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.grid_map import GridMap
from stillmap.core.recording import Recording
from stillmap.pipeline.options import Options
from stillmap.pipeline.quality import Quality
from stillmap.results.reader import Track
from stillmap.tracking import MovingObject


class ResultData:
    """T scans with M beams in D dimensions, their poses and labels, and the map."""

    if TYPE_CHECKING:  # fields of one subclass are properties of the other

        @property
        @abstractmethod
        def recording(self) -> Recording:
            """The recording as it was mapped; a saved result reads it when it is first used."""

        @property
        @abstractmethod
        def map(self) -> GridMap:
            """The map of what is static: `p_occupied` (H, W), `origin`, `resolution` in m."""

        @property
        @abstractmethod
        def poses(self) -> NDArray[np.float64]:
            """(T, D+1, D+1) T_map_base."""

        @property
        @abstractmethod
        def stamp_ns(self) -> NDArray[np.int64]:
            """(T,) stamps of the scans in nanoseconds."""

        @property
        @abstractmethod
        def p_static(self) -> NDArray[np.float32]:
            """(M,) P(c = 1); NaN: unusable, the prior at maximum range."""

        @property
        @abstractmethod
        def hit(self) -> NDArray[np.bool_]:
            """(M,) whether a beam ended on something."""

        @property
        @abstractmethod
        def objects(self) -> Sequence[MovingObject | Track]:
            """Movers: `id`, `stamp_ns` (L,), `xy`, `velocity` (L, 2), `size`, `p_dynamic`,
            `p_identity`."""

        @property
        @abstractmethod
        def quality(self) -> Quality:
            """Of labels and geometry, from 0 to 100; None where it cannot be told."""

        @property
        @abstractmethod
        def warnings(self) -> Sequence[str]:
            """One sentence each."""

        @property
        @abstractmethod
        def options(self) -> Options:
            """Every option as resolved."""

        @property
        @abstractmethod
        def run(self) -> dict[str, Any]:
            """The content of `run.json`."""

        @property
        @abstractmethod
        def deskewed(self) -> Recording:
            """The recording without the motion during its scans, computed at every call."""

    def _stretches(self) -> list[slice]:
        """The scans of each recording that it was made from."""
        return [slice(None)]
