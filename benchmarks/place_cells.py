"""Observations of sessions per cell, and the cells that truly changed between them."""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import scipy  # its parts load when they are first used
from numpy.typing import NDArray
from place_truth import SessionTruth

from stillmap.core.recording import Recording

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

CELL = 0.05  # m
MIN_BEAMS = 3  # that end in a cell or pass it: it was seen
SHORT = 2  # cells before its end, where a beam no longer counts as passing
_NOISE = 2  # cells, within which hits of one surface scatter
_MIN_SHARE = 0.2  # of the hits in the fullest cell within them
_BLOCK = 1 << 20  # beams
_NEIGHBOURS = np.ones((3, 3), bool)


class Lattice(NamedTuple):
    """Square cells in the world: lower-left corner in cells, and (H, W)."""

    low: tuple[int, int]
    shape: tuple[int, int]

    @classmethod
    def around(cls, points: Float) -> "Lattice":
        """One that holds all points (N, 2), and a margin."""
        cells = np.floor(points / CELL).astype(np.int64)
        low, high = cells.min(axis=0) - 3, cells.max(axis=0) + 4
        return cls((int(low[0]), int(low[1])), (int(high[1] - low[1]), int(high[0] - low[0])))

    def cells(self, points: Float) -> NDArray[np.int64]:
        """(N,) flat index of the cells of points (N, 2), which lie within."""
        column, row = (np.floor(points / CELL).astype(np.int64) - self.low).T
        return np.asarray(row * self.shape[1] + column)

    def holds(self, points: Float) -> Bool:
        """(N,) whether points (N, 2) lie within."""
        cells = np.floor(points / CELL).astype(np.int64) - self.low
        return np.asarray(np.all((cells >= 0) & (cells < self.shape[::-1]), axis=1))

    def centres(self) -> Float:
        """(H, W, 2) metres."""
        rows, columns = np.indices(self.shape)
        cells = np.stack([columns + self.low[0], rows + self.low[1]], axis=-1)
        return np.asarray((cells + 0.5) * CELL, np.float64)

    def draw(self, faces: Float) -> Bool:
        """(H, W) the cells that segments (K, 4) run through, but for corners cut by less than a
        tenth of a cell."""
        out = np.zeros(self.shape[0] * self.shape[1], bool)
        for x0, y0, x1, y1 in faces:
            count = int(np.hypot(x1 - x0, y1 - y0) / (CELL / 10)) + 2
            share = np.linspace(0.0, 1.0, count)[:, None]
            points = np.array([x0, y0]) + share * np.array([x1 - x0, y1 - y0])
            out[self.cells(points[self.holds(points)])] = True
        return out.reshape(self.shape)


@dataclass(frozen=True, eq=False)
class Seen:
    """Observations of a session on a lattice.

    Attributes:
        hits, passes: (H, W) int32 beams that end in each cell, or pass it.
    """

    hits: NDArray[np.int32]
    passes: NDArray[np.int32]

    @property
    def seen(self) -> Bool:
        """(H, W) cells that MIN_BEAMS beams ended in or passed."""
        return self.hits + self.passes >= MIN_BEAMS

    @property
    def on_surface(self) -> Bool:
        """(H, W) cells in which MIN_BEAMS beams end, and no small share of the hits nearby."""
        most = scipy.ndimage.maximum_filter(self.hits, size=2 * _NOISE + 1)
        return np.asarray((self.hits >= MIN_BEAMS) & (self.hits >= _MIN_SHARE * most))


def count_beams(recording: Recording, poses: Float, use: Bool, lattice: Lattice) -> Seen:
    """Count the beams that end in each cell and pass it.

    Args:
        recording: planar, of M beams.
        poses: (T, 3, 3) of the robot, in the frame of the lattice.
        use: (M,) beams that count as hits of standing surfaces; others of those that hit only
            pass cells.
        lattice: the cells.
    """
    n = lattice.shape[0] * lattice.shape[1]
    hits, passes = np.zeros(n, np.int64), np.zeros(n, np.int64)
    every = np.flatnonzero(recording.hit)
    for first in range(0, len(every), _BLOCK):
        beams = every[first : first + _BLOCK]
        end = recording.end_points(beams, poses)
        scan = recording.scans_of(beams)
        start = (poses[scan] @ recording.T_base_sensor[recording.sensor[scan]])[:, :2, 2]
        own = use[beams] & lattice.holds(end)
        hits += np.bincount(lattice.cells(end[own]), minlength=n)
        passes += _count_passes(start, end, lattice)
    shape = lattice.shape
    return Seen(hits.astype(np.int32).reshape(shape), passes.astype(np.int32).reshape(shape))


def _count_passes(start: Float, end: Float, lattice: Lattice) -> NDArray[np.int64]:
    """(H W,) how many beams pass each cell, by points a cell apart along them."""
    n = lattice.shape[0] * lattice.shape[1]
    long = np.hypot(*(end - start).T)
    steps = np.floor(long / CELL).astype(np.int64) - SHORT
    order = np.argsort(-steps)
    start, steps = start[order], steps[order]
    along = (end[order] - start) / np.maximum(long[order], 1e-9)[:, None] * CELL
    out = np.zeros(n, np.int64)
    for k in range(int(steps.max(initial=-1)) + 1):
        longer = np.searchsorted(-steps, -k, side="right")
        at = start[:longer] + k * along[:longer]
        out += np.bincount(lattice.cells(at[lattice.holds(at)]), minlength=n)
    return out


class ChangeTruth(Protocol):
    """Observations of S sessions by which changes are scored, on cells of any arrangement."""

    @property
    def seen(self) -> "tuple[Seen, ...]":
        """Of each session."""

    @property
    def surfaces(self) -> Bool:
        """(S, ...) whether a surface of what stands there runs through each cell."""

    @property
    def fixed(self) -> Bool:
        """(...) the same of surfaces that are there in all sessions."""

    @property
    def edge(self) -> float:
        """m, of a cell."""

    def centres(self) -> Float:
        """(..., D) metres, in the world."""

    def mark(self, points: Float) -> Bool:
        """(...) the cells that hold any of points (N, D)."""

    def widen(self, cells: Bool) -> Bool:
        """These cells (...) and their neighbours."""

    def draw_object(self, truth: SessionTruth, number: int, session: int) -> Bool:
        """(...) the cells that an object fills in a session of the truth, without fixed ones."""


class CellTruth(NamedTuple):
    """The truth about the cells of S sessions in the plane.

    Attributes:
        lattice: the cells.
        seen: of each session.
        surfaces: (S, H, W) whether a surface of what stands there runs through the cell.
        fixed: (H, W) the same of surfaces that are there in all sessions.
    """

    lattice: Lattice
    seen: tuple[Seen, ...]
    surfaces: Bool
    fixed: Bool

    @property
    def edge(self) -> float:
        """m, of a cell."""
        return CELL

    def centres(self) -> Float:
        """(H, W, 2) metres."""
        return self.lattice.centres()

    def mark(self, points: Float) -> Bool:
        """(H, W) the cells that hold any of points (N, 2)."""
        out = np.zeros(self.fixed.size, bool)
        out[self.lattice.cells(points[self.lattice.holds(points)])] = True
        return out.reshape(self.fixed.shape)

    def widen(self, cells: Bool) -> Bool:
        """(H, W) these cells and their 8 neighbours."""
        return widen(cells)

    def draw_object(self, truth: SessionTruth, number: int, session: int) -> Bool:
        """(H, W) the cells that an object fills in a session of the truth, without fixed ones."""
        return self.lattice.draw(truth.objects[number].faces_in(session)) & ~self.fixed


def collect_cells(truth: SessionTruth, sessions: list[int]) -> CellTruth:
    """Observations of these sessions at true poses, and true surfaces.

    Raises:
        InputError: a recording or its truth is missing or damaged.
    """
    from stillmap.io.stillmap_folder import read

    recordings = [read(truth.folder / truth.names[k]) for k in sessions]
    beams = [truth.beams(k) for k in sessions]
    walls = [one.walls for one in beams]
    lattice = Lattice.around(np.concatenate(walls).reshape(-1, 2))
    seen = tuple(
        count_beams(recording, one.T_world_base, one.static, lattice)
        for recording, one in zip(recordings, beams, strict=True)
    )
    changed = np.array([one.is_changed for one in truth.objects], bool)
    fixed = _without(walls[0], truth.faces(sessions[0], changed))
    drawn = lattice.draw(fixed)
    surfaces = [drawn | lattice.draw(truth.faces(k, changed)) for k in sessions]
    return CellTruth(lattice, seen, np.array(surfaces), drawn)


def _without(faces: Float, others: Float) -> Float:
    """The faces (K, 4) that are none of the others."""
    gone = {tuple(np.round(face, 6).tolist()) for face in others}
    keep = [tuple(np.round(face, 6).tolist()) not in gone for face in faces]
    return np.asarray(faces[np.array(keep, bool)])


def widen(cells: Bool) -> Bool:
    """(H, W) these cells and their 8 neighbours."""
    return np.asarray(scipy.ndimage.binary_dilation(cells, _NEIGHBOURS))
