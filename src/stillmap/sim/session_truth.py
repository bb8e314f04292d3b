"""The truth about sessions: where each began, what stood where, what changed when."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.sim.options import HeightOptions
from stillmap.sim.planner import Float
from stillmap.sim.session_layout import StandingObject
from stillmap.sim.simulator import Simulation
from stillmap.sim.world_3d import make_parts, trace_loops

FILE = "sessions.json"
_CELL, _CELL_3D = 0.1, 0.5  # m, of the area that counts as observed
_EVERY = 3  # of the scans, for that area
_BLOCK = 200  # scans at once


class TrueChange(NamedTuple):
    """A change between two successive sessions.

    Attributes:
        object: index of the object.
        kind: "appeared", "gone", "moved" or "door".
        box: x0, y0, x1, y1 in metres and in 3D z0, z1; where it is now, or was.
        from_box: where it was, of what moved and of doors.
        between: the last session before and the first one after.
    """

    object: int
    kind: str
    box: tuple[float, ...]
    from_box: tuple[float, ...] | None
    between: tuple[int, int]

    def to_dict(self, number: int, names: list[str]) -> dict[str, Any]:
        """As JSON; `number`: its id."""
        made: dict[str, Any] = {"id": number, "object": self.object, "kind": self.kind}
        made["box"] = list(self.box)
        if self.from_box is not None:
            made["from_box"] = list(self.from_box)
        return {**made, "between": [names[k] for k in self.between]}


def list_changes(
    objects: tuple[StandingObject, ...], heights: HeightOptions | None
) -> list[TrueChange]:
    """The changes between successive sessions, in order.

    Args:
        objects: with their places in each session.
        heights: of a 3D world, for z; None: in 2D.
    """
    changes = []
    sessions = len(objects[0].places) if objects else 0
    for after in range(1, sessions):
        for number, one in enumerate(objects):
            old, new = one.places[after - 1], one.places[after]
            if old == new:
                continue
            z = () if heights is None else (0.0, _height(one, heights))
            was = None if old is None else (*one.extent(after - 1), *z)
            box = None if new is None else (*one.extent(after), *z)
            kind = "appeared" if was is None else "gone" if box is None else "moved"
            kind = "door" if one.kind == "door" else kind
            moved = was if box is not None else None
            changes.append(TrueChange(number, kind, box or was or (), moved, (after - 1, after)))
    return changes


def _height(one: StandingObject, heights: HeightOptions) -> float:
    """m, of the highest part of an object in 3D."""
    loops, _ = trace_loops(one.faces)
    tops = [part.z[1] for loop in loops for part in make_parts(loop, heights)]
    return max(tops, default=heights.furniture)


class Sight(NamedTuple):
    """Observations of one session: cells (K, 2) that it observed, and of each static hit (H, 2)."""

    observed: NDArray[np.int64]
    hits: NDArray[np.int64]


def observe(one: Simulation) -> Sight:
    """The cells that a session observed: passed or hit in 2D, hit in 3D."""
    cell = _CELL_3D if one.scene.in_3d else _CELL
    hits, seen = [], [np.empty((0, 2), np.int64)]
    for scans, start, end, static in _beams_in_world(one):
        hits.append(np.floor(end[static] / cell).astype(np.int64))
        if one.scene.in_3d:
            seen.append(np.unique(hits[-1], axis=0))
        else:
            some = scans % _EVERY == 0
            seen.append(_passed_cells(start[some], end[some], cell))
    return Sight(np.unique(np.concatenate(seen), axis=0), np.concatenate(hits))


def _beams_in_world(
    one: Simulation,
) -> Iterator[tuple[NDArray[np.int64], Float, Float, NDArray[np.bool_]]]:
    """Scan, start and end in the plane, and whether a static surface was hit, of M beams."""
    recording, truth = one.recording, one.truth
    T_world_sensor = truth.T_world_base @ recording.T_base_sensor[recording.sensor]
    for first in range(0, recording.n_scans, _BLOCK):
        last = min(first + _BLOCK, recording.n_scans)
        part = slice(int(recording.offset[first]), int(recording.offset[last]))
        counts = np.diff(recording.offset[first : last + 1])
        scans = np.repeat(np.arange(first, last), counts)
        T = T_world_sensor[scans]
        points = np.asarray(recording.points[part], np.float64)
        end = np.einsum("nij,nj->ni", T[:, :2, :-1], points) + T[:, :2, -1]
        yield scans, T[:, :2, -1], end, np.asarray(truth.static[part])


def _passed_cells(start: Float, end: Float, cell: float) -> NDArray[np.int64]:
    """(K, 2) cells that hold points, a cell apart, along beams from (N, 2) to (N, 2)."""
    if not len(start):
        return np.empty((0, 2), np.int64)
    low = np.floor(np.minimum(start, end).min(axis=0) / cell).astype(np.int64)
    high = np.floor(np.maximum(start, end).max(axis=0) / cell).astype(np.int64)
    seen = np.zeros(high - low + 1, bool)
    steps = np.ceil(np.hypot(*(end - start).T) / cell).astype(np.int64)
    order = np.argsort(-steps)
    start, along, steps = start[order], (end - start)[order], steps[order]
    for n in range(int(steps.max()) + 1):
        longer = np.searchsorted(-steps, -n, side="right")
        at = start[:longer] + (n / np.maximum(steps[:longer], 1))[:, None] * along[:longer]
        seen[tuple((np.floor(at / cell).astype(np.int64) - low).T)] = True
    return np.asarray(np.argwhere(seen) + low)


def compute_overlap(sights: Sequence[Sight], places: Sequence[int]) -> Float:
    """(S, S) share of the static hits of session j in cells that session i observed.

    Sessions of different places have none in common.
    """
    every = np.concatenate([cells for sight in sights for cells in sight])
    low = every.min(axis=0)
    shape = every.max(axis=0) - low + 1
    overlap = np.zeros((len(sights), len(sights)))
    for i, one in enumerate(sights):
        seen = np.zeros(shape, bool)
        seen[tuple((one.observed - low).T)] = True
        for j, other in enumerate(sights):
            if places[i] == places[j] and len(other.hits):
                overlap[i, j] = seen[tuple((other.hits - low).T)].mean()
    return overlap
