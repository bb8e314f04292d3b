"""The changes that `stillmap merge` found, on the cells of the truth."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_folder import read_npz
from stillmap.core.errors import InputError
from stillmap.eval.session_cells import ChangeTruth
from stillmap.eval.session_poses import PlacedSession, read_json

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

_MAX_CELLS = 1 << 31  # bytes of an array when it is unpacked
_CELLS = "changes.npz"
_KINDS = ("appeared", "gone", "moved", "door")


class FoundChange(NamedTuple):
    """A change of a place.

    Attributes:
        kind: as in `changes.json`.
        before, after: index among the accepted sessions, by date.
        came, left: cells of the truth where something is now, and where something was; of doors
            both.
    """

    kind: str
    before: int
    after: int
    came: Bool
    left: Bool

    @property
    def cells(self) -> Bool:
        """All of them."""
        return self.came | self.left


class NamedCells(NamedTuple):
    """The cells that changes name: `change` (N,) ids, `points` (N, D) centres in the world."""

    change: NDArray[np.integer]
    points: Float


def read_named_cells(place: Path, T_world_place: Float) -> NamedCells | None:
    """The cells of all changes; None: the place does not name them.

    Raises:
        InputError: the file is damaged.
    """
    path, D = place / _CELLS, len(T_world_place) - 1
    if not path.is_file():
        return None
    try:
        ids, centres = read_npz(path, ("change", "xyz"[:D]), _MAX_CELLS).values()
        centres = np.asarray(centres, np.float64)
        if centres.shape != (len(ids), D):
            raise ValueError(f"{'xyz'[:D]} is {centres.shape}")
    except (TypeError, ValueError) as error:
        raise InputError(f"is damaged: {error}", where=str(path)) from error
    return NamedCells(ids, _transform(T_world_place, centres))


def read_changes(
    place: Path,
    sessions: list[PlacedSession],
    T_world_place: Float,
    cells: ChangeTruth,
    named: NamedCells | None,
) -> list[FoundChange]:
    """The changes of a place.

    Args:
        place: the folder.
        sessions: the accepted ones, by date.
        T_world_place: (D+1, D+1).
        cells: of the truth.
        named: the cells of the changes; None: all within their boxes.

    Raises:
        InputError: a file is missing or damaged.
    """
    path = place / "changes.json"
    tree = read_json(path)
    index = {one.name: k for k, one in enumerate(sessions)}
    T_place_world = np.asarray(np.linalg.inv(T_world_place), np.float64)
    at = _transform(T_place_world, cells.centres())
    try:
        return [_read_change(one, index, at, cells, named) for one in tree]
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise InputError(f"is damaged: {error!r}", where=str(path)) from error


def _read_change(
    one: dict[str, Any],
    index: dict[str, int],
    at: Float,
    cells: ChangeTruth,
    named: NamedCells | None,
) -> FoundChange:
    kind, (before, after) = str(one["kind"]), (index[name] for name in one["between"])
    if kind not in _KINDS:
        raise ValueError(f"kind '{kind}'")
    box = _fill(one["box"], at, cells.edge)
    was = _fill(one["from_box"], at, cells.edge) if one.get("from_box") else np.zeros_like(box)
    if named is not None:
        own = cells.mark(named.points[named.change == int(one["id"])])
        box, was = box & own, was & own
    if kind == "door":
        box = was = box | was
    elif kind == "gone":
        box, was = np.zeros_like(box), box
    return FoundChange(kind, before, after, box, was)


def _fill(box: list[float], at: Float, margin: float) -> Bool:
    """Those of the points (..., D) that lie within a box x0, y0, x1, y1, in 3D also z0, z1."""
    edges = [float(value) for value in box]
    inside = np.ones(at.shape[:-1], bool)
    for axis, (low, high) in enumerate(((0, 2), (1, 3), (4, 5))[: at.shape[-1]]):
        x = at[..., axis]
        inside &= (x >= edges[low] - margin) & (x <= edges[high] + margin)
    return inside


def _transform(T: Float, points: Float) -> Float:
    D = len(T) - 1
    return np.asarray(points @ T[:D, :D].T + T[:D, D])
