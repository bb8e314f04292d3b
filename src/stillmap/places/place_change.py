"""A change between sessions of a place, and the files that list them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from stillmap.core.local_frame import LocalFrame
from stillmap.core.short_repr import ShortRepr
from stillmap.places.place_states import PlaceStates

Float = NDArray[np.float64]
Index = NDArray[np.intp]
Kind = Literal["appeared", "gone", "moved", "door"]


@dataclass(frozen=True, eq=False)
class PlaceChange(ShortRepr):
    """Something that is otherwise from one session to the next that looked.

    Attributes:
        kind: it appeared, is gone, moved, or is a door in another position.
        low, high: (D,) m, corners of its box: where it is now, or was.
        from_low, from_high: (D,) of where it was before it moved; None otherwise.
        before, after: indices of the sessions, in the order of time.
        probability: that it changed.
        cells: (K,) indices of its cells in `PlaceStates`, of both positions.
    """

    kind: Kind
    low: Float
    high: Float
    before: int
    after: int
    probability: float
    cells: Index
    from_low: Float | None = None
    from_high: Float | None = None


def change_records(
    changes: Sequence[PlaceChange], names: Sequence[str], frame: LocalFrame
) -> list[dict[str, object]]:
    """The entries of `changes.json`.

    Args:
        changes: in the order of time.
        names: of the sessions, in the order of time.
        frame: of the changes, in the map frame.
    """
    out = []
    for number, one in enumerate(changes):
        record: dict[str, object] = {
            "id": number,
            "kind": one.kind,
            "box": _corners(one.low, one.high, frame),
        }
        if one.from_low is not None and one.from_high is not None:
            record["from_box"] = _corners(one.from_low, one.from_high, frame)
        record["between"] = [names[one.before], names[one.after]]
        record["probability"] = round(one.probability, 4)
        out.append(record)
    return out


def _corners(low: Float, high: Float, frame: LocalFrame) -> list[float]:
    """x0, y0, x1, y1, and in 3D z0, z1, in the map frame."""
    low, high = frame.points_to_map(low), frame.points_to_map(high)
    plane = [*low[:2], *high[:2]]
    return [round(float(x), 3) for x in (*plane, *(v for z in (low[2:], high[2:]) for v in z))]


def change_cells(
    changes: Sequence[PlaceChange], place: PlaceStates, frame: LocalFrame
) -> dict[str, NDArray[np.generic]]:
    """The cells of all changes: `change` (K,) the entry of `changes.json`, and `xy` (K, 2) or `xyz`
    (K, 3), the centres of the cells in metres."""
    cells = [one.cells for one in changes]
    number = np.repeat(np.arange(len(changes), dtype=np.int32), [len(of) for of in cells])
    of = np.concatenate([np.zeros(0, np.intp), *cells])
    D = place.cells.shape[1]
    centres = frame.points_to_map((place.cells[of] + 0.5) * place.resolution)
    return {"change": number, "xyz"[:D]: centres}
