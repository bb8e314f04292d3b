"""Does quality from 0 to 100 rank mixed runs as the truth does?

python benchmarks/quality_scores.py --seeds 230 293 [--lidar] [--processes 2] [--json ROWS]

Each seed draws a world, laser, crowd, resolution, estimator and odometry (`mixed_runs.py`), with
--lidar a world, lidar, voxels, method and poses in 3D (`mixed_sweeps.py`). Printed are Spearman's
rank correlation of each part with its scores, and the runs that are judged worst.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mixed_sweeps
import numpy as np
from common import built, finite, make_parser, outcomes, result_scores
from mixed_runs import draw
from numpy.typing import NDArray
from prepared import prepare
from scipy.stats import rankdata, spearmanr
from tables import Row, markdown

import stillmap

Float = NDArray[np.float64]

_GEOMETRY = (("ate", -1.0), ("walls", 1.0), ("ghosts", -1.0))  # score and sign: more is better
_SHOWN = 12  # runs whose rank is furthest from that of the truth


def main() -> None:
    p = make_parser(__doc__)
    p.add_argument("--seeds", type=int, nargs=2, default=(230, 293), metavar=("FIRST", "LAST"))
    p.add_argument("--lidar", action="store_true", help="runs in 3D")
    p.add_argument("--processes", type=int, default=2)
    p.add_argument("--json", type=Path, help="append rows to this file, one a line")
    args = p.parse_args()
    seeds = list(range(args.seeds[0], args.seeds[1] + 1))
    row_of = _row_of_sweeps if args.lidar else _row_of
    rows = [row for _, row in outcomes(row_of, seeds, args.processes)]
    rows.sort(key=lambda row: row["seed"])
    if args.json:
        with args.json.open("a") as file:
            file.writelines(json.dumps(row) + "\n" for row in rows)
    print(report(rows))


def _row_of(seed: int) -> dict[str, Any]:
    drawn = draw(seed)
    run = prepare(drawn.case(), seed)
    recording, poses = drawn.inputs(run.simulation)
    result, cpu_ms = built(recording, drawn.options(), poses)
    return _row(drawn, result, result_scores(result, cpu_ms, run))


def _row_of_sweeps(seed: int) -> dict[str, Any]:
    drawn = mixed_sweeps.draw(seed)
    simulation = drawn.simulate()
    recording, poses = drawn.inputs(simulation)
    result, _ = built(recording, drawn.options(), poses)
    scored = {"held_out": None, **mixed_sweeps.scores_of(result, simulation)}
    return _row(drawn, result, scored)


def _row(drawn: object, result: stillmap.Result, scored: Mapping[str, Any]) -> dict[str, Any]:
    """What was drawn, the quality, its share of the CPU time, and the scores."""
    quality = result.quality
    seconds = [float(stage.get("cpu_seconds") or 0) for stage in result.stages.values()]
    about = {
        **vars(drawn),
        "labels": quality.labels,
        "geometry": quality.geometry,
        "overall": quality.overall,
        "cost": float(result.stages["quality"]["cpu_seconds"]) / sum(seconds),
    }
    return finite({**about, **scored})


def report(rows: Sequence[Row]) -> str:
    """Correlations, cost, and the runs that are judged worst."""
    ranks = [_ranks(sign * column(rows, name)) for name, sign in _GEOMETRY]
    truths = {
        "labels": _ranks(column(rows, "f1")),
        "geometry": np.nanmean(ranks, axis=0),
        "overall": np.nanmean([*ranks, _ranks(column(rows, "f1"))], axis=0),
    }
    lines = [
        [part, str(_count(rows, part)), f"{spearman(column(rows, part), truth):.3f}"]
        for part, truth in truths.items()
    ]
    if np.isfinite(column(rows, "held_out")).any():
        held_out = spearman(column(rows, "held_out"), truths["overall"])
        lines.append(["held-out likelihood, as overall", str(len(rows)), f"{held_out:.3f}"])
    cost = np.median(column(rows, "cost"))
    return "\n".join(
        [
            markdown(["part", "runs", "Spearman"], lines),
            f"\nshare of the CPU time, median: {100 * cost:.1f} %\n",
            _worst(rows, truths),
        ]
    )


def _worst(rows: Sequence[Row], truths: dict[str, Float]) -> str:
    lines = []
    for part in ("labels", "geometry"):
        off = _ranks(column(rows, part)) - _ranks(truths[part])
        for k in np.argsort(-np.abs(np.nan_to_num(off)))[:_SHOWN]:
            row = rows[int(k)]
            about = (row[key] for key in ("world", "laser", "method", "odometry"))
            scores = [
                "-" if row[key] is None else f"{row[key]:.3g}"
                for key in (part, "f1", "ate", "walls", "ghosts")
            ]
            lines.append([part, str(row["seed"]), ", ".join(map(str, about)), *scores])
    return markdown(["part", "seed", "run", "figure", "F1", "ATE", "walls", "ghosts"], lines)


def column(rows: Sequence[Row], name: str) -> Float:
    """(n,) of a score; NaN where a run has none."""
    return np.array([np.nan if row[name] is None else row[name] for row in rows], dtype=np.float64)


def _count(rows: Sequence[Row], name: str) -> int:
    """Runs that have a score."""
    return int(np.count_nonzero(np.isfinite(column(rows, name))))


def spearman(a: Float, b: Float) -> float:
    """Of the runs that have both."""
    known = np.isfinite(a) & np.isfinite(b)
    return float(spearmanr(a[known], b[known]).statistic)


def _ranks(values: Float) -> Float:
    """From 0 to 1; NaN stays."""
    out = np.full(len(values), np.nan)
    known = np.isfinite(values)
    out[known] = rankdata(values[known]) / max(1, np.count_nonzero(known))
    return out


if __name__ == "__main__":
    main()
