"""True changes between sessions that could be observed: objects that came or left, and doors."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.eval.session_cells import MIN_BEAMS, ChangeTruth
from stillmap.eval.session_truth import SessionTruth

Bool = NDArray[np.bool_]

MIN_CELLS = 5  # of an object's surface, seen before and after: its change could be found


class Event(NamedTuple):
    """An object that came to a place or left it.

    Attributes:
        came: to it.
        seen: the last session that saw the place before, and the first one after.
        true: the last session before and the first one after, whether they saw it or not.
        cells: (H, W), in 3D (K,), of its surface, that both of `seen` saw.
    """

    came: bool
    seen: tuple[int, int]
    true: tuple[int, int]
    cells: Bool

    def is_dated(self, before: int, after: int) -> bool:
        """Whether a change between two sessions has the right date."""
        early = self.seen[0] <= before <= self.true[0]
        return early and self.true[1] <= after <= self.seen[1]


def list_events(cells: ChangeTruth, truth: SessionTruth, sessions: list[int]) -> Iterator[Event]:
    """The true changes between the sessions that could be observed."""
    for change in truth.changes:
        one = truth.objects[change.object]
        for came, at in ((True, change.between[1]), (False, change.between[0])):
            surface = cells.draw_object(truth, change.object, at)
            if not surface.any():
                continue
            looked = [
                surface & _looked(cells, k, one.places[s] == one.places[at])
                for k, s in enumerate(sessions)
            ]
            enough = [int(mask.sum()) >= MIN_CELLS for mask in looked]
            before = [k for k, s in enumerate(sessions) if s <= change.between[0]]
            after = [k for k, s in enumerate(sessions) if s >= change.between[1]]
            seen = ([k for k in before if enough[k]][-1:], [k for k in after if enough[k]][:1])
            if not seen[0] or not seen[1]:
                continue
            first, last = seen[0][0], seen[1][0]
            states = [one.places[sessions[k]] == one.places[at] for k in (first, last)]
            both = looked[first] & looked[last]
            if states == [not came, came] and both.sum() >= MIN_CELLS:
                yield Event(came, (first, last), (before[-1], after[0]), both)


def _looked(cells: ChangeTruth, session: int, is_there: bool) -> Bool:
    """Cells in which a session saw that a surface is there, or is not."""
    seen = cells.seen[session]
    return cells.widen(seen.hits >= MIN_BEAMS) if is_there else seen.passes >= MIN_BEAMS
