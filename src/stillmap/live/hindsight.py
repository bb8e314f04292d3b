"""Scans that are labelled once more after a while, when more is known."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.core.short_repr import ShortRepr
from stillmap.live.scan import ScanBeams


@dataclass(frozen=True, eq=False)
class LaterLabels(ShortRepr):
    """Labels of an earlier scan by what is known now.

    Attributes:
        number: how many scans were pushed before it.
        p_static: (N,) float32 of its beams; NaN: unusable.
    """

    number: int
    p_static: NDArray[np.float32]


class Hindsight:
    """The scans of the last seconds.

    Args:
        lag: s after which they are taken; None: none are kept.
    """

    def __init__(self, lag: float | None) -> None:
        self._lag_ns = None if lag is None else round(1e9 * lag)
        self._scans = deque[tuple[int, ScanBeams]]()

    def add(self, number: int, beams: ScanBeams) -> None:
        """Keep a scan, the number of which is that of scans before it."""
        if self._lag_ns is not None:
            self._scans.append((number, beams))

    def take(self, stamp_ns: int) -> Iterator[tuple[int, ScanBeams]]:
        """The scans that are old enough now, and not taken yet."""
        while self._scans and stamp_ns - self._scans[0][1].stamp_ns >= (self._lag_ns or 0):
            yield self._scans.popleft()
