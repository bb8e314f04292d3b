"""What beams see of the cells in which any of them ended, look by look, under classes of chains.

Recordings piece by piece: what one kernel call sees is bounded, whatever the length.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.recording import Recording
from stillmap.em.mixture import LEARN_FROM
from stillmap.em.options import DwellOptions, EmOptions

_PROMINENT = 0.1  # share of the richest cell's beams that noise alone hardly brings into another

_EDGE = 0.15  # cells: how sharply a surface ends


Float = NDArray[np.float64]

SurfelMap = _core.Surface2D | _core.Surface3D

OccupancyHmm = _core.Dwell2D | _core.Dwell3D

Rows = tuple[int, int, int]

CHUNK_BEAMS = 1 << 20

_WIDEST = 8  # chunks that one may be as large as, for threads to share it out


class Chunk(NamedTuple):
    """Some scans in a row.

    Attributes:
        scans: which ones.
        beams: their beams.
        offset: (n + 1,) where each scan's beams begin within these.
    """

    scans: slice
    beams: slice
    offset: NDArray[np.int64]


def iter_chunks(
    recording: Recording,
    group: NDArray[np.int64] | None = None,
    *,
    min_groups: int = 1,
    release: Sequence[NDArray[Any]] = (),
) -> Iterator[Chunk]:
    """Chunks of about CHUNK_BEAMS beams; scans of equal `group` (T,), rising, stay together.

    At least so many `groups` are in a chunk, where there are as many, and as long as it has fewer
    than _WIDEST times that many beams: threads share these out. What of the recording, and of
    arrays `beside` it, lies in files is let go after each chunk.
    """
    offset, first = recording.offset, 0
    while first < recording.n_scans:
        end = int(np.searchsorted(offset, offset[first] + CHUNK_BEAMS, side="right")) - 1
        end = min(max(end, first + 1), recording.n_scans)
        if group is not None and end < recording.n_scans:
            start = int(np.searchsorted(group, group[end]))  # of the group that would be cut
            end = max(start, _after(group, offset, first, max(min_groups, 1)))
        beams = slice(int(offset[first]), int(offset[end]))
        within = np.ascontiguousarray(offset[first : end + 1] - offset[first])
        yield Chunk(slice(first, end), beams, within)
        recording.release_pages(*release)
        first = end


def _after(group: NDArray[np.int64], offset: NDArray[np.int64], first: int, groups: int) -> int:
    """The first scan after so many groups, or after fewer that have many beams, or after all."""
    most = offset[first] + _WIDEST * CHUNK_BEAMS
    for _ in range(groups):
        if first < len(group) and offset[first] < most:
            first = int(np.searchsorted(group, group[first], side="right"))
    return first


HALF_TIME_RHO = 0.5  # share of the time in which something is there that comes and goes often

_LEAST = 0.3  # cells: no length is known better, whatever the scatter

_SWALLOWED = 4.0  # one in so many beams without a return through walls: none is trusted

_ROWS = 1 << 14  # elements that are looked at together

_LOOKS_EACH = 2  # of each thread: a look is never shared, and some take longer than others

_LAST_LOOK = 2**31 - 1  # as far as the core counts


@dataclass(frozen=True)
class HmmClasses:
    """Grid over what a cell may hold: how much of the time it is occupied, and for how long.

    The shares of these classes are learned; the grid itself only has to be wide and fine enough.

    Attributes:
        static_occupied, static_seconds: share of the time and correlation time in seconds of what
            stands still: one, but for looks that miss it, which come in runs.
        views_occupied, views_turn: of what stands still and is met from some places only: the share
            of them, and by how many radians the view turns until it is met or not anew.
        mover_occupied, mover_seconds: of what comes and goes.
        often_seconds: of what comes and goes and is there for half of the time.
    """

    static_occupied: tuple[float, ...] = (0.998, 0.95)
    static_seconds: tuple[float, ...] = (25.0, 100.0)
    views_occupied: tuple[float, ...] = ()
    views_turn: float = 0.4
    mover_occupied: tuple[float, ...] = (0.01, 0.04, 0.15)
    mover_seconds: tuple[float, ...] = (0.5, 3.0, 12.0, 45.0)
    often_seconds: tuple[float, ...] = ()

    @property
    def n_static(self) -> int:
        return len(self.static_occupied) * len(self.static_seconds) + len(self.views_occupied)

    def grid(self) -> tuple[list[float], list[float], list[float]]:
        """rho, tau, turn of each: static ones first, those of half of the time last."""
        never = float("inf")
        of = [(r, t, never) for t in self.static_seconds for r in self.static_occupied]
        of += [(r, never, self.views_turn) for r in self.views_occupied]
        of += [(r, t, never) for t in self.mover_seconds for r in self.mover_occupied]
        of += [(HALF_TIME_RHO, t, never) for t in self.often_seconds]
        return [r for r, _, _ in of], [t for _, t, _ in of], [v for _, _, v in of]


LOOP_CLASSES = HmmClasses()


@dataclass(frozen=True, eq=False)
class ClassLikelihoods:
    """How likely what was seen of E elements is under each of C classes.

    Attributes:
        rho, tau, turn: (C,) of the classes; the first `n_static` are static.
        likelihood: (E, C) under each class, relative to the best; its logarithm is `log_best`.
    """

    rho: Float
    tau: Float
    turn: Float
    n_static: int
    likelihood: NDArray[np.float32]
    log_best: Float


@dataclass(frozen=True, eq=False)
class Observations:
    """What all looks say of E elements.

    Attributes:
        surface: the elements.
        dwell: what was seen of them.
        trust: how far beams without a return are believed, from 0 to 1.
        rho, tau, turn: (C,) of the classes; the first `n_static` are static.
        threads: same result with any number.
    """

    surface: SurfelMap
    dwell: OccupancyHmm
    trust: float
    rho: Float
    tau: Float
    turn: Float
    n_static: int
    threads: int = 1

    def under(
        self, kept: NDArray[np.bool_] | None = None, rows: Rows | None = None
    ) -> ClassLikelihoods:
        """Of some of the classes (C,), all static ones among them, as if there were no others.

        rows: first, last, every: of some of the elements.
        """
        some = slice(None) if kept is None else kept
        found = self.dwell.likelihood(kept, rows, self.threads)
        return ClassLikelihoods(
            self.rho[some], self.tau[some], self.turn[some], self.n_static, *found
        )

    def blocks(self) -> Iterator[Rows]:
        """All elements: tables of all of them at once would be as large as what they are from."""
        return iter_surfel_rows(self.surface)

    def sample(self) -> Rows:
        """So many of them, evenly, that shares can be learned from."""
        return 0, self.surface.size, max(-(-self.surface.size // LEARN_FROM), 1)


def collect_observations(
    recording: Recording,
    poses: Float,
    resolution: float,
    options: EmOptions,
    threads: int,
    classes: HmmClasses = LOOP_CLASSES,
    prepare: Callable[[OccupancyHmm], None] | None = None,
) -> Observations:
    """Follows all beams; `prepare` is called before the first look. See `e_step`."""
    T_map_sensor = recording.T_map_sensor(poses)
    look = time_bin_index(recording, options.dwell.look) if recording.dimension == 3 else None
    surface = build_surfel_map(recording, T_map_sensor, resolution, threads, look)
    dwell = make_hmm(surface, options.dwell, classes, threads)
    trust = _estimate_trust(recording, T_map_sensor, dwell, threads)
    dwell.trust(trust)
    if prepare is not None:
        prepare(dwell)
    add_observations(recording, poses, dwell, options.dwell.look, threads)
    dwell.rest()
    rho, tau, turn = (np.array(values) for values in classes.grid())
    return Observations(surface, dwell, trust, rho, tau, turn, classes.n_static, threads)


def build_surfel_map(
    recording: Recording,
    T_map_sensor: Float,
    resolution: float,
    threads: int = 1,
    look: NDArray[np.int64] | None = None,
) -> SurfelMap:
    """Mean, normal and scatter of the end points in every cell where beams ended.

    With the look (T,) of each scan it also knows when they did.
    """
    kind = _core.Surface2D if recording.dimension == 2 else _core.Surface3D
    surface = kind(resolution)
    for scans, beams, offset in iter_chunks(recording):
        points, hit = recording.points[beams], recording.hit[beams]
        of_scans = None if look is None else look[scans]
        surface.add_end_points(points, hit, offset, T_map_sensor[scans], of_scans, threads)
    surface.fit(threads)
    return surface


def iter_surfel_rows(surface: SurfelMap) -> Iterator[Rows]:
    """All elements, some of them at a time; one empty block where there are none."""
    for first in range(0, max(surface.size, 1), _ROWS):
        yield first, min(first + _ROWS, surface.size), 1


def surfel_cells(surface: SurfelMap) -> NDArray[np.int64]:
    """(E, D) of the elements."""
    return np.concatenate([surface.elements(rows)[0] for rows in iter_surfel_rows(surface)])


def time_bin_index(recording: Recording, seconds: float) -> NDArray[np.int64]:
    """(T,) the look of each scan: what was seen within it tells no more than a single glance.

    A clock that leaps by decades makes one look of what comes after.
    """
    since = recording.stamp_ns - recording.stamp_ns[0]
    number = since // max(round(seconds * 1e9), 1)
    return np.asarray(np.minimum(number, _LAST_LOOK), dtype=np.int64)


def add_observations(
    recording: Recording, poses: Float, dwell: OccupancyHmm, seconds: float, threads: int
) -> None:
    """All looks at each element, one after the other."""
    look, D = time_bin_index(recording, seconds), recording.dimension
    T_map_sensor = recording.T_map_sensor(poses)
    place = np.ascontiguousarray(poses[:, :D, D])
    for scans, beams, offset in iter_chunks(recording, look, min_groups=_LOOKS_EACH * threads):
        dwell.add(
            recording.points[beams],
            recording.hit[beams],
            offset,
            T_map_sensor[scans],
            look[scans],
            threads,
            place[scans],
        )


def make_hmm(
    surface: SurfelMap, options: DwellOptions, classes: HmmClasses, threads: int = 1
) -> OccupancyHmm:
    rho, tau, turn = classes.grid()
    cell, scatter = surface.resolution, surface.scatter
    lengths = {
        "lateral": max(options.lateral * scatter, _LEAST * cell),
        "margin": options.margin * scatter + 0.5 * cell,
        "reach": options.reach * scatter + 0.7 * cell,  # half a cell's diagonal
        "beyond": options.beyond,
    }
    chosen: dict[str, Any] = {
        "rho": rho,
        "tau": tau,
        "turn": turn,
        "detection": options.detection,
        "seconds": options.look,
        "normals": options.normals,
        "threads": threads,
        **lengths,
    }
    if isinstance(surface, _core.Surface2D):
        return _core.Dwell2D(surface, **chosen)
    return _core.Dwell3D(surface, **chosen)


def _estimate_trust(
    recording: Recording, T_map_sensor: Float, dwell: OccupancyHmm, threads: int
) -> float:
    """How far beams without a return show that nothing is there, from 0 to 1.

    Where there is open space they cross nothing solid. Where most of them seem to go through walls,
    something swallows them.
    """
    lost = through = 0
    for scans, beams, offset in iter_chunks(recording):
        counts = dwell.lost(
            recording.points[beams], recording.hit[beams], offset, T_map_sensor[scans], threads
        )
        lost, through = lost + counts[0], through + counts[1]
    return max(0.0, 1.0 - _SWALLOWED * through / lost) if lost else 0.0


def probability_in_cell(surface: SurfelMap) -> NDArray[np.float32]:
    """(E,) P(what is there runs through the cell itself): noise also fills cells beside it."""
    from scipy.special import ndtr  # takes long to load

    covered = np.empty(surface.size, np.float32)
    for rows in iter_surfel_rows(surface):
        _, _, normals, off_plane, prominence, _ = surface.elements(rows)
        # of the cell, across the surface; a wall on the border of two cells belongs to both
        half = 0.5 * np.abs(normals).sum(axis=1) + _EDGE
        runs = ndtr((half - np.abs(off_plane / surface.resolution)) / _EDGE)
        lone = np.minimum(prominence / _PROMINENT, 1.0)
        covered[slice(*rows)] = np.where(normals.any(axis=1), runs, lone)
    return covered
