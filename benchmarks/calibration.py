"""Is P(static) the share that is static? By look counts, by time in sight, and by range.

python benchmarks/calibration.py [--cases populated "everyone stops"] [--methods stillmap]
    [--seeds tuning|reporting] [--n-seeds 1] [--set section.key=value ...] [--true-poses]

A look is a second in which beams passed through, or ended in, the cell in which a beam ended.
All beams of a cell share its fate, so few cells make many beams: what a perfectly calibrated answer
would show in the same cells stands beside what was found.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from cases import POPULATED, STOPS
from common import (
    Run,
    add_arguments,
    add_run_arguments,
    built,
    make_parser,
    options_of,
    outcomes,
    runs_of,
)
from numpy.typing import NDArray
from prepared import RESOLUTION, counts
from tables import grouped, markdown

from stillmap.core.recording import Recording
from stillmap.results.eval.labels import UNSURE, assign_equal_mass_bins, compute_calibration_error
from stillmap.sim import simulate

Float = NDArray[np.float64]

# lower edges of the bins; the last one is open
LOOKS = (1, 2, 3, 5, 9, 17, 33, 65)
SPANS = (0, 1, 3, 10, 30, 100)  # s from the first look to the last
RANGES = (0, 1, 2, 5, 10, 20)  # m
FIXED = (0, 0.001, 0.01, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99, 0.999)
_DRAWS = 30  # of labels, to see what chance makes of an error
# title, column of Beams, lower edges
SPLITS = (
    ("looks", "looks", LOOKS),
    ("seconds from first to last look", "span", SPANS),
    ("range, m", "range", RANGES),
)


@dataclass(frozen=True, eq=False)
class Beams:
    """What is known of (N,) beams that hit something and carry a label."""

    p: Float
    static: NDArray[np.bool_]
    looks: NDArray[np.int32]
    span: NDArray[np.int32]
    range: Float
    cell: NDArray[np.intp]  # in which they ended, numbered
    door: NDArray[np.bool_]  # on a leaf that moved at any time, seen by the laser or not

    def of(self, which: NDArray[np.bool_]) -> "Beams":
        return Beams(*(getattr(self, name)[which] for name in self.__dataclass_fields__))


def main() -> None:
    p = make_parser(__doc__)
    add_arguments(p, ["stillmap"])
    add_run_arguments(p, [POPULATED, STOPS, "street-oncoming", "corridor-40-once"])
    args = p.parse_args()
    done = list(outcomes(_beams_of, runs_of(args, args.methods), args.processes))
    for method, some in grouped(done, lambda pair: pair[0].method).items():
        beams = joined([beams for _, beams in some])
        named = [(f"{run.case.name}, {run.seed}", one) for run, one in some]
        print(f"\n## {method}: {len(some)} runs, {len(beams.p)} beams that hit something\n")
        named += [("all", beams), ("all but doors", beams.of(~beams.door))]
        print("\n\n".join([*_tables(beams), *_by_run(named)]))


def joined(parts: Sequence[Beams]) -> Beams:
    """All beams; cells of different runs keep different numbers."""
    first = np.cumsum([0, *(int(part.cell.max(initial=-1)) + 1 for part in parts)])
    parts = [replace(part, cell=part.cell + k) for part, k in zip(parts, first, strict=False)]
    names = Beams.__dataclass_fields__
    return Beams(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def _beams_of(run: Run) -> Beams:
    sim = simulate(run.case.build(), run.seed)
    recording, truth = sim.recording, sim.truth
    poses = truth.T_world_base if run.true_poses else None
    result, _ = built(recording, options_of(run.method, run.settings), poses)
    looks, span = looks_of(recording, result.poses)
    ranges = np.hypot(*recording.points.T.astype(np.float64))
    _, cell = np.unique(_end_cells(recording, result.poses), axis=0, return_inverse=True)
    p = result.p_static.astype(np.float64)
    door = np.array([*truth.scene["mover_kinds"], "none"])[truth.mover] == "door"
    all_beams = Beams(p, truth.static, looks, span, ranges, cell.ravel(), door)
    return all_beams.of(recording.hit & ~np.isnan(result.p_static))


def looks_of(recording: Recording, poses: Float) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Of the cell in which each beam (M,) ended: in how many seconds it was looked at, and how
    many seconds lie between the first and the last of them."""
    ones = np.ones(recording.n_beams, np.float32)
    whole = counts(recording, recording.points, recording.hit, ones, poses)
    corner, alpha, _ = whole.dense()
    count, first, last = (np.zeros(alpha.shape, np.int32) for _ in range(3))
    for second, scans in _seconds(recording):
        seen_corner, alpha, beta = _looked_at(recording, poses, scans)
        x, y = seen_corner - corner
        part = np.s_[y : y + alpha.shape[0], x : x + alpha.shape[1]]
        seen = alpha + beta > 0
        first[part][seen & (count[part] == 0)] = second
        last[part][seen] = second
        count[part] += seen
    cells = _end_cells(recording, poses) - corner
    column, row = np.clip(cells, 0, np.array(count.shape)[::-1] - 1).T
    return np.maximum(count[row, column], 1), (last - first)[row, column]


def _seconds(recording: Recording) -> Iterator[tuple[int, slice]]:
    """The scans of each second in which there are any."""
    second = (recording.stamp_ns - recording.stamp_ns[0]) // 10**9
    starts = np.flatnonzero(np.diff(second, prepend=-1))
    for start, end in itertools.pairwise([*starts.tolist(), len(second)]):
        yield int(second[start]), slice(start, end)


def _looked_at(
    recording: Recording, poses: Float, scans: slice
) -> tuple[NDArray[np.int64], Float, Float]:
    """The sums of (10) of some scans alone."""
    offset = recording.offset[scans.start : scans.stop + 1]
    beams = slice(int(offset[0]), int(offset[-1]))
    part = Recording(
        stamp_ns=recording.stamp_ns[scans],
        offset=offset - offset[0],
        points=recording.points[beams],
        hit=recording.hit[beams],
        T_base_sensor=recording.T_base_sensor,
        sensor=recording.sensor[scans],
        T_odom_base=None,
    )
    ones = np.ones(part.n_beams, np.float32)
    return counts(part, part.points, part.hit, ones, poses[scans]).dense()


def _end_cells(recording: Recording, poses: Float) -> NDArray[np.int64]:
    """(M, 2) column and row; 0 for a beam that cannot be used."""
    T = np.repeat(recording.T_map_sensor(poses), np.diff(recording.offset), axis=0)
    points = np.nan_to_num(recording.points.astype(np.float64))
    ends = np.einsum("mij,mj->mi", T[:, :2, :2], points) + T[:, :2, 2]
    return np.floor(ends / RESOLUTION).astype(np.int64)


def _tables(beams: Beams) -> Iterator[str]:
    yield "Fixed bins of P(static):"
    yield _split_table("P(static)", beams, beams.p, FIXED)
    unsure = beams.of(_is_unsure(beams.p))
    yield f"Equal-mass bins of the {len(unsure.p)} unsure beams, {UNSURE[0]} < P < {UNSURE[1]}:"
    of_bin = assign_equal_mass_bins(unsure.p) if len(unsure.p) else np.empty(0, np.intp)
    lines = [_line(str(k + 1), unsure.of(of_bin == k)) for k in np.unique(of_bin).tolist()]
    yield markdown(_HEADER, lines)
    for title, name, edges in SPLITS:
        yield f"By {title}:"
        yield _split_table(title, beams, getattr(beams, name), edges)


_HEADER = (
    "bin",
    "beams",
    "mean P(static)",
    "truly static",
    "P - truth",
    "Brier",
    "ECE",
    "unsure",
    "ECE unsure",
)


def _split_table(title: str, beams: Beams, values: Float, edges: Sequence[float]) -> str:
    of_bin = np.searchsorted(edges, values, side="right") - 1
    names = [f"[{low:g}, {high:g})" for low, high in itertools.pairwise(edges)]
    names.append(f"{edges[-1]:g} or more")
    lines = [_line(name, beams.of(of_bin == k)) for k, name in enumerate(names)]
    return markdown((title, *_HEADER[1:]), [*lines, _line("all", beams)])


def _line(name: str, beams: Beams) -> list[str]:
    n = len(beams.p)
    if not n:
        return [name, "0", *["-"] * (len(_HEADER) - 2)]
    unsure = _is_unsure(beams.p)
    return [
        name,
        str(n),
        f"{beams.p.mean():.4f}",
        f"{beams.static.mean():.4f}",
        f"{(beams.p - beams.static).mean():+.4f}",
        f"{((beams.p - beams.static) ** 2).mean():.4f}",
        f"{_ece(beams):.4f}",
        f"{100 * unsure.mean():.2f} %",
        f"{_ece(beams.of(unsure)):.3f}" if unsure.any() else "-",
    ]


def _is_unsure(p: Float) -> NDArray[np.bool_]:
    return (p > UNSURE[0]) & (p < UNSURE[1])


def _ece(beams: Beams) -> float:
    return compute_calibration_error(beams.p, beams.static, assign_equal_mass_bins(beams.p))


def if_calibrated(beams: Beams, rng: np.random.Generator) -> float:
    """Mean ECE if each cell were static, as a whole, with its mean probability."""
    cells, cell = np.unique(beams.cell, return_inverse=True)
    mean = np.bincount(cell, beams.p) / np.bincount(cell)
    drawn = (rng.random((_DRAWS, len(cells))) < mean)[:, cell]
    of_bin = assign_equal_mass_bins(beams.p)
    return float(np.mean([compute_calibration_error(beams.p, static, of_bin) for static in drawn]))


def _by_run(runs: Sequence[tuple[str, Beams]]) -> Iterator[str]:
    yield "Unsure beams by run; what a perfectly calibrated answer would show in these cells:"
    rng, lines = np.random.default_rng(0), []
    for name, beams in runs:
        unsure = beams.of(_is_unsure(beams.p))
        if len(unsure.p):
            counted = [str(len(unsure.p)), str(len(np.unique(unsure.cell)))]
            found = [f"{_ece(unsure):.3f}", f"{if_calibrated(unsure, rng):.3f}"]
            lines.append([name, *counted, *found])
    yield markdown(["run", "unsure beams", "their cells", "ECE", "if calibrated"], lines)


if __name__ == "__main__":
    main()
