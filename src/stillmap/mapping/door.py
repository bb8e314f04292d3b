"""A door as it was observed."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.short_repr import ShortRepr
from stillmap.em.options import MapState

Cells = NDArray[np.int64]
Position = Literal["open", "shut"]


class DoorState(NamedTuple):
    """A time in which every observation saw the leaf in one position.

    Attributes:
        position: `open` or `shut`.
        since_ns, until_ns: stamps of the first and the last scan that saw it so.
    """

    position: Position
    since_ns: int
    until_ns: int


@dataclass(frozen=True, eq=False)
class Door(ShortRepr):
    """A leaf that swings about a hinge.

    Attributes:
        hinge: metres, in the map frame.
        length: metres, of the leaf.
        shut, opened: rad, directions from the hinge along the leaf. Shut is the one in which a wall
            goes on beyond the leaf. NaN: it was never seen open.
        shut_cells, open_cells: (K, 2) cells that changed, of the leaf in each position.
        swept_cells: (S, 2) all that it sweeps over.
        states: in the order of time; one of a door that was seen in one position only. Cells of a
            position in which its leaf was never seen are none.
        p_moved: probability that it is a door that moved during the recording; 1: it was seen to.
    """

    hinge: tuple[float, float]
    length: float
    shut: float
    opened: float
    shut_cells: Cells
    open_cells: Cells
    swept_cells: Cells
    states: tuple[DoorState, ...] = ()
    p_moved: float = 1.0

    def position_in(self, state: MapState) -> Position:
        """Position of the leaf in a map: the last one, or that of most of the time, or as asked."""
        if state in ("open", "shut"):
            return "open" if state == "open" else "shut"
        if state == "last" or len(self.states) == 1:
            return self.states[-1].position
        seconds = {"open": 0, "shut": 0}
        for one in self.states:
            seconds[one.position] += one.until_ns - one.since_ns
        return "open" if seconds["open"] >= seconds["shut"] else "shut"
