"""Which beams in space are labelled wrongly: by range, height, speed, standing time, evidence.

python benchmarks/space_errors.py CASE LABELS.npy

CASE is a folder that `space.py --keep` left, LABELS.npy one of the files of labels in it. Heights
are those above the lowest points (5 %) of squares of 2 m. "sweeps there" are those of which beams
ended in the same voxel of 0.3 m. Speeds and standing times are those of what a beam met, and known
in simulation alone. "of these" is the share of wrong labels among the beams of a row, "of all" the
share of all wrong labels that the row has.
"""

import argparse
import itertools
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from space_cases import Known, known_of_given
from tables import markdown

Float = NDArray[np.float64]

_SQUARE = 2.0  # m, whose lowest points are the ground
_LOWEST = 0.05  # share of its points that count as lowest
_VOXEL = 0.3  # m
_STANDS = 0.1  # m/s
_EDGES = {
    "range, m": (2.5, 5, 10, 15, 20, 30, 40, 50),
    "height, m": (-99, -0.1, 0.1, 0.2, 0.3, 0.5, 1, 1.5, 2, 3, 5, 99),
    "sweeps there": (1, 2, 3, 5, 10, 20, 50, 1e9),
    "speed, m/s": (0, _STANDS, 0.5, 1, 2, 4, 8, 40),
    "standing, s": (0, 0.05, 1, 3, 5, 10, 15, 20, 30, 60, 1e9),
    "P(static)": (0, 0.01, 0.05, 0.2, 0.5, 0.8, 0.95, 0.99, 0.999, 1.001),
}


def main() -> None:
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("case", type=Path)
    p.add_argument("labels", type=Path)
    args = p.parse_args()
    known, p_static = known_of_given(args.case), np.load(args.labels)
    of = {**properties(args.case), "P(static)": p_static.astype(float)}
    wrong = (p_static < 0.5) == known.static
    print(by_kind(known, wrong))
    for name, values in of.items():
        print(f"\n{table(name, values, _EDGES[name], known, wrong)}")


def properties(case: Path) -> dict[str, Float]:
    """(K,) each, of the beams that all were given."""
    offset, T = np.load(case / "offset.npy"), np.load(case / "T_map_sensor.npy")
    points = np.fromfile(case / "points.bin", np.float32).reshape(-1, 3)
    sweep = np.repeat(np.arange(len(T)), np.diff(offset))
    ends = np.empty(points.shape)
    for t, pose in enumerate(T):
        part = slice(offset[t], offset[t + 1])
        ends[part] = points[part] @ pose[:3, :3].T + pose[:3, 3]
    return {
        "range, m": np.linalg.norm(points.astype(float), axis=1),
        "height, m": above_ground(ends),
        "sweeps there": sweeps_there(ends, sweep),
        **_motion(case, sweep),
    }


def above_ground(ends: Float) -> Float:
    """(K,) m above the lowest points of the square that each point (K, 3) is in."""
    square = _groups(np.floor(ends[:, :2] / _SQUARE))
    order = np.lexsort((ends[:, 2], square))
    count = np.bincount(square)
    first = np.cumsum(count) - count
    ground = ends[order[first + (_LOWEST * count).astype(int)], 2]
    return np.asarray(ends[:, 2] - ground[square])


def sweeps_there(ends: Float, sweep: NDArray[np.intp]) -> Float:
    """(K,) how many sweeps have points (K, 3) in the voxel of each."""
    voxel = _groups(np.floor(ends / _VOXEL))
    pairs = np.unique(voxel.astype(np.int64) * (int(sweep.max()) + 1) + sweep)
    return np.bincount(pairs // (int(sweep.max()) + 1)).astype(float)[voxel]


def _groups(cells: Float) -> NDArray[np.intp]:
    """(K,) number of the cell that each row of (K, D) is."""
    cells = (cells - cells.min(axis=0)).astype(np.int64)
    size = [int(n) for n in cells.max(axis=0) + 1]
    flat = np.ravel_multi_index(tuple(cells.T), size)
    return np.asarray(np.unique(flat, return_inverse=True)[1])


def _motion(case: Path, sweep: NDArray[np.intp]) -> dict[str, Float]:
    """Speed of what each beam met and how long it stands there in all; NaN: it is no mover."""
    source = Path(json.loads((case / "case.json").read_text())["source"])
    if not (source / "truth").is_dir():
        return {}
    mover = np.load(source / "truth" / "mover.npy", mmap_mode="r")[np.load(case / "beam.npy")]
    where = np.load(source / "truth" / "movers.npy")[..., :2]
    seconds = 1e-9 * np.load(source / "stamp_ns.npy")
    pace = np.linalg.norm(np.diff(where, axis=0), axis=2) / np.diff(seconds)[:, None]
    pace = np.concatenate([pace, pace[-1:]])
    standing = standing_times(pace < _STANDS, float(np.median(np.diff(seconds))))
    at = (sweep, np.maximum(mover, 0))
    return {
        "speed, m/s": np.where(mover >= 0, pace[at], np.nan),
        "standing, s": np.where(mover >= 0, standing[at], np.nan),
    }


def standing_times(stands: NDArray[np.bool_], period: float) -> Float:
    """(T, P) seconds that each stands there in all, 0 while it moves, given when it stands."""
    out = np.zeros(stands.shape)
    for k, one in enumerate(stands.T):
        turns = np.flatnonzero(np.diff(np.concatenate([[0], one, [0]])))
        for start, end in zip(turns[::2], turns[1::2], strict=True):
            out[start:end, k] = (end - start) * period
    return out


def by_kind(known: Known, wrong: NDArray[np.bool_]) -> str:
    """A line for every kind of thing."""
    lines = []
    for number, name in enumerate(known.kinds):
        of = known.scored & (known.kind == number)
        if of.any():
            lines.append([name, str(of.sum()), str(wrong[of].sum()), _percent(wrong[of])])
    return markdown(["kind", "beams", "wrong", "%"], lines)


def table(
    name: str, values: Float, edges: Sequence[float], known: Known, wrong: NDArray[np.bool_]
) -> str:
    """A line for every interval [a, b) of a property, of static and of dynamic beams."""
    lines = []
    for low, high in itertools.pairwise(edges):
        inside, cells = (values >= low) & (values < high), []
        for truth in (known.static, ~known.static):
            of = known.scored & truth
            some, all_wrong = of & inside, max(int((of & wrong).sum()), 1)
            share = 100.0 * (some & wrong).sum() / all_wrong
            cells += [str(some.sum()), _percent(wrong[some]), f"{share:.0f}"]
        if (known.scored & inside).any():
            lines.append([f"{low:g} to {high:g}", *cells])
    of_both = ["static", "% of these", "% of all", "dynamic", "% of these", "% of all"]
    return markdown([name, *of_both], lines)


def _percent(wrong: NDArray[np.bool_]) -> str:
    return f"{100.0 * wrong.mean():.2f}" if len(wrong) else "-"


if __name__ == "__main__":
    main()
