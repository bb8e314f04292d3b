"""Observations of surfels: hits and misses in time bins, and their likelihood under each class.

All beams of a cell within one time bin make at most one observation. `docs/estimator.md` has the
observation model; the kernels follow it.
"""

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

import stillmap._core as _core
from stillmap.core.array_types import Bool, Float, Float32, Int64
from stillmap.core.chunks import ScanBeams, iter_beams
from stillmap.core.parallel import counting_threads
from stillmap.core.recording import Recording
from stillmap.em.mixture import MAX_FIT_ROWS, log_beta
from stillmap.em.options import EmOptions

SurfelMap = _core.SurfelMap2D | _core.SurfelMap3D
OccupancyHmm = _core.OccupancyHmm2D | _core.OccupancyHmm3D
Rows = tuple[int, int, int]  # first, last + 1 and step of some surfels

HALF_TIME_RHO = 0.5  # of classes for what comes and goes, as doors do
# P(observed as occupied | occupied): lower values forgive more misses, and keep what has left; with
# higher ones a few grazing beams open a wall
P_DETECTION = 0.97
MAX_RANGE_MARGIN = 0.3  # m, end of a maximum-range beam that is not used as free space

# multiples of the noise of end points, to which a part of the cell is added
_LATERAL = 0.7  # standard deviation of a beam's lateral position
_MARGIN = 3.0  # a beam has passed a surface if it ends at least this far behind it
_HIT_RADIUS = 4.0  # distance from a surfel's mean within which end points are hits
_MIN_LATERAL = 0.3  # cells

MIN_TRUST = 0.5  # in beams without a return, above which they clear free space
_TRUST_SLOPE = 4.0  # trust reaches 0 where one in four beams without a return crosses solid cells
_SURFELS_PER_BLOCK = 1 << 14
_BINS_PER_THREAD = 2  # minimum, for load balance: a time bin is processed by one thread
_MAX_BIN = 2**31 - 1  # the kernels count in 32 bits

_MIN_PROMINENCE = 0.1  # share of the most-hit neighbour's end points that noise hardly exceeds
_EDGE = 0.15  # cells, how sharply a surface ends


@dataclass(frozen=True)
class HmmClasses:
    """Grid of two-state Markov chains, the classes of the mixture; their weights are learned.

    The grid must cover the range of rho and tau finely enough; its exact values do not matter.

    Attributes:
        static_rho, static_tau: stationary probability of being occupied, and correlation time in
            seconds, of static surface; misses of it come in runs.
        view_rho, view_angle: of view-dependent static surface, whose chains evolve with the
            viewing direction instead of time: rho, and the correlation angle in radians.
        dynamic_rho, dynamic_tau: of movers.
        half_time_tau: of what is there for half of the time, with rho = HALF_TIME_RHO.
    """

    static_rho: tuple[float, ...] = (0.998, 0.95)
    static_tau: tuple[float, ...] = (25.0, 100.0)
    view_rho: tuple[float, ...] = ()
    view_angle: float = 0.4
    dynamic_rho: tuple[float, ...] = (0.01, 0.04, 0.15)
    dynamic_tau: tuple[float, ...] = (0.5, 3.0, 12.0, 45.0)
    half_time_tau: tuple[float, ...] = ()

    @property
    def n_static(self) -> int:
        return len(self.static_rho) * len(self.static_tau) + len(self.view_rho)

    def grid(self) -> tuple[list[float], list[float], list[float]]:
        """rho, tau and view angle of each class: static ones first, half-time ones last."""
        never = float("inf")
        of = [(r, t, never) for t in self.static_tau for r in self.static_rho]
        of += [(r, never, self.view_angle) for r in self.view_rho]
        of += [(r, t, never) for t in self.dynamic_tau for r in self.dynamic_rho]
        of += [(HALF_TIME_RHO, t, never) for t in self.half_time_tau]
        rho, tau, view_angle = map(list, zip(*of, strict=True))
        return rho, tau, view_angle


LOOP_CLASSES = HmmClasses()


@dataclass(frozen=True, eq=False)
class Observations:
    """Forward filters of E surfels, run over all observations.

    Attributes:
        surfel_map: the surfels.
        hmm: the forward filters.
        trust: in beams without a return, 0 to 1.
        rho, tau, view_angle: (C,) of the classes; the first `n_static` are static.
        has_surroundings: whether `hmm.miss_counts` is known.
        threads: does not change the result.
    """

    surfel_map: SurfelMap
    hmm: OccupancyHmm
    trust: float
    rho: Float
    tau: Float
    view_angle: Float
    n_static: int
    threads: int = 1
    has_surroundings: bool = False

    def likelihood(
        self, classes: Bool | None = None, rows: Rows | None = None
    ) -> tuple[Float32, Float]:
        """Likelihood of the observations of surfels under some of the classes.

        Args:
            classes: (C,) mask with all static ones; None: all.
            rows: first, last + 1 and step of the surfels; None: all.

        Returns:
            (E, C) relative to the best class, and the logarithm (E,) of that one.
        """
        return self.hmm.likelihood(classes, rows, self.threads)

    def likelihood_of_surroundings(self, rows: Rows) -> Float32:
        """(K, 2) of the misses of some surfels; see `surroundings.likelihood_of_misses`."""
        assert isinstance(self.hmm, _core.OccupancyHmm3D)
        return likelihood_of_misses(self.hmm.miss_counts(rows))

    def sample_rows(self) -> Rows:
        """Every k-th surfel, enough of them to fit mixture weights."""
        return 0, self.surfel_map.size, max(-(-self.surfel_map.size // MAX_FIT_ROWS), 1)


def collect_observations(
    recording: Recording,
    poses: Float,
    resolution: float,
    options: EmOptions,
    threads: int,
    classes: HmmClasses = LOOP_CLASSES,
    changes: dict[str, Any] | None = None,
    *,
    with_surroundings: bool = False,
) -> Observations:
    """Runs the forward filters of all cells in which beams ended over a recording.

    Args:
        recording, poses, resolution, options, threads: see `occupancy_hmm.e_step`.
        classes: of the filters.
        changes: parameters of the change HMM, which runs along; None: it does not.
        with_surroundings: also count what is hit around each surfel while it is missed; 3D only.
    """
    time_bin = time_bin_index(recording, options.time_bin)
    surfel_map = build_surfel_map(recording, poses, resolution, threads, time_bin)
    hmm = make_hmm(surfel_map, options, classes, threads)
    trust, used_trust, blind = _estimate_trust(recording, poses, hmm, threads)
    hmm.set_trust_beyond_solid(used_trust)
    if changes is not None:
        hmm.track_changes(**changes)
    if with_surroundings:
        assert isinstance(hmm, _core.OccupancyHmm3D)
        hmm.track_surroundings(EDGE)
    add_observations(recording, poses, hmm, options.time_bin, threads, without_blank=blind)
    hmm.release_buffers()
    rho, tau, view_angle = (np.array(values) for values in classes.grid())
    n_static = classes.n_static
    return Observations(
        surfel_map, hmm, trust, rho, tau, view_angle, n_static, threads, with_surroundings
    )


def build_surfel_map(
    recording: Recording,
    poses: Float,
    resolution: float,
    threads: int = 1,
    time_bin: Int64 | None = None,
) -> SurfelMap:
    """Mean, normal and noise of the end points in every cell where beams ended.

    With the time bin (T,) of each scan the map also knows from when to when a cell was hit.
    """
    kind = _core.SurfelMap2D if recording.dimension == 2 else _core.SurfelMap3D
    surfel_map = kind(resolution)
    for scans, _, data in iter_beams(recording, poses):
        bins = None if time_bin is None else time_bin[scans]
        surfel_map.add_end_points(*data, bins, counting_threads(len(data.hit), threads))
    surfel_map.fit(threads)
    return surfel_map


def iter_surfel_rows(surfel_map: SurfelMap) -> Iterator[Rows]:
    """All surfels in blocks; one empty block where there are none."""
    for first in range(0, max(surfel_map.size, 1), _SURFELS_PER_BLOCK):
        yield first, min(first + _SURFELS_PER_BLOCK, surfel_map.size), 1


def surfel_cells(surfel_map: SurfelMap) -> Int64:
    """(E, D) cell of each surfel."""
    return np.concatenate([surfel_map.surfels(rows)[0] for rows in iter_surfel_rows(surfel_map)])


def time_bin_index(recording: Recording, seconds: float) -> Int64:
    """(T,) time bin of each scan, counted from the first scan.

    After a clock jump of decades all scans fall into the last bin.
    """
    since = recording.stamp_ns - recording.stamp_ns[0]
    number = since // max(round(seconds * 1e9), 1)
    return np.asarray(np.minimum(number, _MAX_BIN), dtype=np.int64)


def add_observations(
    recording: Recording,
    poses: Float,
    hmm: OccupancyHmm,
    seconds: float,
    threads: int,
    *,
    without_blank: bool = False,
) -> None:
    """Adds the observations of all time bins to the filters, in order.

    without_blank: leave out the scans without a single return.
    """
    time_bin, D = time_bin_index(recording, seconds), recording.dimension
    positions = np.ascontiguousarray(poses[:, :D, D])
    min_groups = _BINS_PER_THREAD * threads
    for scans, _, data in iter_beams(recording, poses, time_bin, min_groups=min_groups):
        used = _without_blank_scans(data) if without_blank else data
        hmm.add(*used, time_bin[scans], threads, positions[scans])


def make_hmm(
    surfel_map: SurfelMap, options: EmOptions, classes: HmmClasses, threads: int = 1
) -> OccupancyHmm:
    """The forward filters of all surfels, without observations."""
    rho, tau, view_angle = classes.grid()
    cell, noise_std = surfel_map.resolution, surfel_map.noise_std
    is_2d = isinstance(surfel_map, _core.SurfelMap2D)
    kind: Any = _core.OccupancyHmm2D if is_2d else _core.OccupancyHmm3D
    hmm: OccupancyHmm = kind(
        surfel_map,
        rho=rho,
        tau=tau,
        view_angle=view_angle,
        p_detection=P_DETECTION,
        bin_seconds=options.time_bin,
        lateral_std=max(_LATERAL * noise_std, _MIN_LATERAL * cell),
        margin=_MARGIN * noise_std + 0.5 * cell,
        hit_radius=_HIT_RADIUS * noise_std + 0.7 * cell,  # half the diagonal of a 2D cell
        end_margin=MAX_RANGE_MARGIN,
        use_normals=True,  # planes, with the angle of incidence
        threads=threads,
    )
    return hmm


def _estimate_trust(
    recording: Recording, poses: Float, hmm: OccupancyHmm, threads: int
) -> tuple[float, float, bool]:
    """Trust in beams without a return, and whether the sensor was blind.

    In the open few of them cross solid cells; where glass or black surfaces swallow beams many do.
    So do those of a sensor that is blind for a while, in scans without a single return.

    Returns:
        trust in all; the weight of their misses beyond a solid cell; whether scans without a return
        are to be left out, in which case the weight is that of the other scans.
    """
    counts, seeing = np.zeros(2), np.zeros(2)  # beams, and those that cross solid cells
    for *_, data in iter_beams(recording, poses):
        in_chunk = np.array(hmm.count_no_return_beams(*data, threads))
        counts += in_chunk
        if (with_returns := _without_blank_scans(data)) is not data:
            in_chunk = np.array(hmm.count_no_return_beams(*with_returns, threads))
        seeing += in_chunk
    blank = counts - seeing
    blind = bool(blank[0] > 0 and _trust(blank) < MIN_TRUST)
    return _trust(counts), _trust(seeing if blind else counts), blind


def _trust(counts: Float) -> float:
    """max(0, 1 - 4 nu), nu the share of some beams without a return that crosses solid cells."""
    n_beams, n_crossing = counts.tolist()
    return max(0.0, 1.0 - _TRUST_SLOPE * n_crossing / n_beams) if n_beams else 0.0


def _without_blank_scans(data: ScanBeams) -> ScanBeams:
    """The same scans; those without a single return have no usable beams."""
    n_hits, n_beams = np.diff(np.append(0, np.cumsum(data.hit))[data.offset]), np.diff(data.offset)
    blank = np.repeat(n_hits == 0, n_beams)
    if not blank.any():
        return data
    return data._replace(points=np.where(blank[:, None], np.float32(np.nan), data.points))


def probability_in_cell(surfel_map: SurfelMap) -> Float32:
    """(E,) probability that the surface runs through the cell: noise also fills cells beside it."""
    out = np.empty(surfel_map.size, np.float32)
    for rows in iter_surfel_rows(surfel_map):
        _, _, normals, off_plane, prominence, _ = surfel_map.surfels(rows)
        # half the cell's extent along the normal; a wall on a border belongs to both cells
        half = 0.5 * np.abs(normals).sum(axis=1) + _EDGE
        in_plane = _core.normal_cdf((half - np.abs(off_plane / surfel_map.resolution)) / _EDGE)
        without_plane = np.minimum(prominence / _MIN_PROMINENCE, 1.0)
        out[slice(*rows)] = np.where(normals.any(axis=1), in_plane, without_plane)
    return out


EDGE = 0.3  # m, of the cells that surroundings are made of: they reach 0.3 to 0.6 m
_LASTING = 9.0  # Beta(9, 1): share of the misses during which lasting surroundings are hit
_MAX_MISSES = 20  # that count; more of one surfel are not independent


def likelihood_of_misses(counts: Float32) -> Float32:
    """Likelihood (K, 2) of the misses of surfels if their surroundings last, and if they empty.

    Args:
        counts: (K, 2) misses, and those during which something was hit in the surroundings.

    Both are beta-binomial: the share of the latter is distributed as Beta(9, 1) and Beta(1, 9).
    They are relative to the larger one.
    """
    misses, surrounded = counts.astype(np.float64).T
    scale = np.minimum(1.0, _MAX_MISSES / np.maximum(misses, 1.0))
    n = np.rint(misses * scale).astype(np.intp)
    k = np.minimum(np.rint(surrounded * scale).astype(np.intp), n)
    return np.asarray(_table()[n, k])


@functools.cache
def _table() -> Float32:
    """(N, N, 2) by the numbers of misses and of those with hits in the surroundings."""
    n, k = np.indices((_MAX_MISSES + 1, _MAX_MISSES + 1)).astype(np.float64)
    rest = np.maximum(n - k, 0)
    lasting = log_beta(k + _LASTING, rest + 1.0)
    logs = np.stack([lasting, log_beta(k + 1.0, rest + _LASTING)], axis=2)
    table = np.asarray(np.exp(logs - logs.max(axis=2, keepdims=True)), np.float32)
    table.setflags(write=False)
    return table
