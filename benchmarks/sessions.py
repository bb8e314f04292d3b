"""`stillmap merge` on sessions of one place: alignment, changes, growth, laps and pieces.

python benchmarks/sessions.py alignment --data DIR [--first-seed 0] [--seeds 3]
    [--lasers FOLDER]
python benchmarks/sessions.py labels --data DIR [--worlds office hall] [--first-seed 1]
    [--seeds 3] [--people N]
python benchmarks/sessions.py growth --data DIR [--world office] [--sessions 32]
python benchmarks/sessions.py laps LOG.clf.gz --data DIR
python benchmarks/sessions.py cuts --data DIR [--worlds office hall] [--seeds 3] [--pieces 4]

alignment: pairs of simulated sessions from random starts, by how much of the second one's hits lie
in what the first one saw, and pairs that have nothing in common; --lasers: also two logs of
different buildings, NAME.clf.gz, in pairs.
labels: five sessions of a place: cells that changed, dates, ghosts and walls; the single sessions
beside it.
growth: each session is mapped, then one result after the other is added to the place; at 2, 4,
8 ... also all at once.
laps: a log with NAME.reference.txt and NAME.relations beside it, cut into laps that are turned and
shifted at random, against the uncut run.
cuts: long simulated runs, cut likewise into equal sessions, against the uncut run.

Simulated sessions are kept in DIR and used again; of growth also their results. Times are
wall-clock unless they are named CPU.
"""

import argparse
import itertools
import json
import os
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import session_merging as merging
from common import make_parser
from place_poses import FRAME_DT, PoseScores
from place_scores import score_place
from session_laps import write_cuts, write_laps
from session_sets import LASER, PairSet, prepare_days, prepare_pairs
from tables import markdown

from stillmap.results.eval.readers import read_planar_trajectory, read_relations, read_trajectory
from stillmap.results.eval.trajectory import (
    ErrorStats,
    associate_trajectories,
    compute_absolute_errors,
    compute_relation_errors,
)
from stillmap.sim import scene_by_name, simulate, write_simulation

_STRANGERS = (("aces", "fr101"), ("fr101", "edmonton"), ("aces", "seattle"))
_LAP_SEED, _SCANS_PER_CUT = 4, 1000

Mapped = tuple[Path, float]  # a result, and the CPU seconds of mapping it
Done = tuple[merging.Merged, PoseScores | None]  # a pair


def main() -> None:
    args = _parser().parse_args()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    args.data.mkdir(parents=True, exist_ok=True)
    print(args.run(args), flush=True)


def _parser() -> argparse.ArgumentParser:
    p = make_parser(__doc__)
    commands = p.add_subparsers(required=True)
    for name, run in (
        ("alignment", align_pairs),
        ("labels", score_labels),
        ("growth", grow),
        ("laps", merge_laps),
        ("cuts", merge_cuts),
    ):
        one = commands.add_parser(name)
        one.set_defaults(run=run)
        one.add_argument("--data", type=Path, required=True, help="folder for sessions and places")
        if name in ("alignment", "labels", "cuts"):
            one.add_argument("--seeds", type=int, default=3)
        if name in ("alignment", "labels"):
            one.add_argument("--first-seed", type=int, default=0 if name == "alignment" else 1)
        if name == "alignment":
            one.add_argument("--lasers", type=Path)
        if name in ("labels", "cuts"):
            one.add_argument("--worlds", nargs="+", default=["office", "hall"])
        if name == "labels":
            one.add_argument("--sessions", type=int, default=5)
            one.add_argument("--people", type=int, help="in each session (default: the world's)")
        if name == "growth":
            one.add_argument("--world", default="office")
            one.add_argument("--sessions", type=int, default=32)
            one.add_argument("--scans", type=int)
        if name == "laps":
            one.add_argument("log", type=Path)
        if name == "cuts":
            one.add_argument("--pieces", type=int, default=3)
    return p


def align_pairs(args: argparse.Namespace) -> str:
    """A line per class of overlap and per negative."""
    rows: dict[str, list[Done]] = {}
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    for pair in prepare_pairs(args.data, seeds):
        done = _align(pair, args)
        print(f"{pair.folder.name}: {_describe(*done)}", file=sys.stderr, flush=True)
        rows.setdefault(pair.kind, []).append(done)
    for one, other in _STRANGERS if args.lasers else ():
        logs = [args.lasers / f"{name}.clf.gz" for name in (one, other)]
        merged = merging.merge(logs, args.data / "places/strangers")
        rows.setdefault("other buildings", []).append((merged, None))
    titles = ["overlap", "pairs", "right", "coarse", "wrong", "refused"]
    titles += ["median m (max)", "median deg (max)", "seam m (max)", "s (max)"]
    return markdown(titles, [_alignment_row(kind, done) for kind, done in rows.items()])


def _align(pair: PairSet, args: argparse.Namespace) -> Done:
    sessions = [pair.folder / f"session-{k}" for k in (1, 2)]
    place = args.data / "places" / pair.folder.name
    merged = merging.merge(sessions, place)
    scores = merging.poses_of(merged, pair.folder)
    shutil.rmtree(place, ignore_errors=True)
    return merged, scores[1] if len(scores) > 1 else None


def _alignment_row(
    kind: str, done: Sequence[tuple[merging.Merged, PoseScores | None]]
) -> list[str]:
    verdicts = [_verdict(merged, scores) for merged, scores in done]
    placed = [s for _, s in done if s is not None and np.isfinite(s.translation)]
    counts = [str(verdicts.count(v)) for v in ("right", "coarse", "wrong", "refused")]
    return [
        kind,
        str(len(done)),
        *counts,
        _median_and_max([s.translation for s in placed], ".3f"),
        _median_and_max([s.rotation for s in placed], ".3f"),
        _median_and_max([s.median_seam for s in placed if np.isfinite(s.median_seam)], ".3f"),
        _median_and_max([merged.seconds for merged, _ in done], ".1f"),
    ]


def _verdict(merged: merging.Merged, scores: PoseScores | None) -> str:
    """What became of the second session; without scores: of a pair of strangers."""
    if scores is None:
        return "refused" if merged.status == merging.REFUSED else "wrong"
    return "refused" if scores.verdict.startswith("refused") else scores.verdict


def _describe(merged: merging.Merged, scores: PoseScores | None) -> str:
    off = "" if scores is None else f", {scores.translation:.3f} m"
    return f"{_verdict(merged, scores)}{off}, {merged.seconds:.1f} s; {merged.words}"


def _median_and_max(values: Sequence[float], form: str) -> str:
    if not values:
        return "-"
    return f"{np.median(values):{form}} ({max(values):{form}})"


def score_labels(args: argparse.Namespace) -> str:
    """A line per world and seed."""
    lines = []
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    for world, seed in itertools.product(args.worlds, seeds):
        days = prepare_days(args.data, world, args.sessions, seed, people=args.people)
        sessions = [days / f"session-{k + 1}" for k in range(args.sessions)]
        singles = []
        for session in sessions:
            result = args.data / "singles" / days.name / session.name
            if not (result / "map.npz").exists():
                merging.build_map(session, result)
            singles.append(result)
        merged = merging.merge(sessions, args.data / "places" / days.name)
        if merged.status == merging.REFUSED:
            lines.append([world, str(seed), "refused", *["-"] * 9])
            continue
        lines.append(_labels_row(world, seed, merged, days, singles))
    titles = ["world", "seed", "right / all", "max m", "F1 changed", "precision", "recall"]
    titles += ["dates right", "spurious", "walls kept", "ghosts (best single)", "s"]
    return markdown(titles, lines)


def _labels_row(
    world: str, seed: int, merged: merging.Merged, days: Path, singles: Sequence[Path]
) -> list[str]:
    s = score_place(merged.place, days, singles)
    own, *others = s.maps
    return [
        world,
        str(seed),
        f"{s.right} / {len(s.sessions)}",
        f"{np.nanmax([one.max_distance for one in s.sessions]):.3f}",
        *(f"{v:.4f}" for v in (s.changes.f1, s.changes.precision, s.changes.recall)),
        f"{s.changes.dates_right:.3f} of {s.changes.events_found}/{s.changes.events}",
        f"{s.changes.spurious} of {s.changes.changes}",
        f"{own.walls_kept:.4f}",
        f"{own.avoidable_ghosts} ({min(one.avoidable_ghosts for one in others)})",
        f"{merged.seconds:.1f}",
    ]


def grow(args: argparse.Namespace) -> str:
    """A line per session that is added; times, memory, bytes, and how it agrees with all at
    once."""
    days = prepare_days(args.data, args.world, args.sessions, 1, args.scans)
    sessions = [days / f"session-{k + 1}" for k in range(args.sessions)]
    mapped = [_map_once(one, args.data / f"maps-{days.name}") for one in sessions]
    work = args.data / "places" / f"growth-{days.name}"
    shutil.rmtree(work, ignore_errors=True)
    hours, lines, place = _hours(sessions[0]), [], mapped[0][0]
    for k in range(1, args.sessions):
        hours += _hours(sessions[k])
        merged = merging.merge([place, mapped[k][0]], work / f"place-{k + 1}")
        if merged.status == merging.REFUSED:
            lines.append([str(k + 1), "refused: " + merged.words, *["-"] * 11])
            continue
        lines.append(_growth_row(k + 1, merged, hours, mapped, work))
        print("|".join(lines[-1]), flush=True)
        if place.parent == work:
            shutil.rmtree(place)
        place = merged.place
    titles = ["sessions", "map: CPU s", "merge: CPU s", "s", "peak MB", "place MB", "kB per m2"]
    titles += ["MB per h", "at once: CPU s", "s", "peak MB", "poses differ, m", "labels F1"]
    return markdown(titles, lines)


def _map_once(session: Path, folder: Path) -> Mapped:
    """The result of a session, mapped unless it is there, and the CPU seconds that it took."""
    result, note = folder / session.name, folder / f"{session.name}.cpu"
    if not note.exists():
        note.write_text(str(merging.build_map(session, result).cpu))
    return result, float(note.read_text())


def _growth_row(
    count: int, merged: merging.Merged, hours: float, mapped: Sequence[Mapped], work: Path
) -> list[str]:
    size = merging.folder_bytes(merged.place)
    line = [str(count), f"{mapped[count - 1][1]:.1f}", *_costs(merged), f"{size / 1e6:.1f}"]
    line += [f"{size / 1e3 / merging.known_m2(merged.place):.1f}", f"{size / 1e6 / hours:.1f}"]
    if count & (count - 1):
        return [*line, *[""] * 5]
    results = [one for one, _ in mapped[:count]]
    at_once = merging.merge(results, work / "at-once")
    if at_once.status == merging.REFUSED:
        return [*line, "refused", *["-"] * 4]
    differ = merging.largest_difference(merged.place, at_once.place)
    f1 = merging.labels_f1(merged.place, at_once.place)
    return [*line, *_costs(at_once), f"{differ:.4f}", f"{f1:.4f}"]


def _costs(merged: merging.Merged) -> list[str]:
    return [f"{merged.cpu:.1f}", f"{merged.seconds:.1f}", f"{merged.memory / 1e6:.0f}"]


def _hours(session: Path) -> float:
    stamps = np.load(session / "stamp_ns.npy", mmap_mode="r")
    return float(stamps[-1] - stamps[0]) / 3.6e12


def merge_laps(args: argparse.Namespace) -> str:
    """The uncut run and the merged laps, by their errors against known relations."""
    name = args.log.name.removesuffix(".clf.gz")
    folder = args.data / f"laps-{name}"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    reference = args.log.with_name(f"{name}.reference.txt")
    laps = write_laps(args.log, reference, folder, np.random.default_rng(_LAP_SEED))
    uncut = merging.build_map(args.log, folder / "uncut")
    merged = merging.merge(laps, folder / "place")
    lines = []
    for what, done in (("uncut", uncut), (f"{len(laps)} laps merged", merged)):
        if done.status == merging.REFUSED:
            lines.append([what, "refused", *["-"] * 6])
            continue
        placed = f"{_accepted(done.place)} of {len(laps)}" if done is merged else "-"
        for relations in (f"{name}.exact.relations", f"{name}.relations"):
            if (path := args.log.with_name(relations)).exists():
                row = _relation_row(done.place / "trajectory.tum", path)
                lines.append([what, relations, placed, *row, f"{done.seconds:.0f}"])
    titles = ["run", "relations", "laps placed", "used", "trans m (median)", "rot deg"]
    return markdown([*titles, "squared m2", "s"], lines)


def _accepted(place: Path) -> int:
    return sum(one["accepted"] for one in _records(place))


def _records(place: Path) -> list[dict]:
    return json.loads((place / "sessions.json").read_text())


def _relation_row(trajectory: Path, relations: Path) -> list[str]:
    errors = compute_relation_errors(
        read_planar_trajectory(trajectory), read_relations(relations), None, 0.1, False
    )
    t = errors.translation
    return [
        f"{errors.used} of {errors.relations}",
        f"{t.mean:.4f} ({t.median:.4f})",
        f"{errors.rotation.mean:.3f}",
        f"{t.squared_mean:.4f}",
    ]


def merge_cuts(args: argparse.Namespace) -> str:
    """A line per simulated run: errors of the uncut run and of the merged cuts."""
    lines = []
    for world, seed in itertools.product(args.worlds, range(1, args.seeds + 1)):
        folder = args.data / f"cuts-{world}-{seed}"
        shutil.rmtree(folder, ignore_errors=True)
        changes = {**LASER, "robot": {"scans": _SCANS_PER_CUT * args.pieces}}
        simulation = simulate(scene_by_name(world, changes), seed)
        write_simulation(simulation, folder / "run")
        rng = np.random.default_rng([_LAP_SEED, seed])
        cuts = write_cuts(folder / "run", folder, args.pieces, rng)
        uncut = merging.build_map(folder / "run", folder / "uncut")
        merged = merging.merge(cuts, folder / "place")
        if merged.status == merging.REFUSED:
            lines.append([world, str(seed), "none", *["-"] * 5])
            continue
        errors = [_trajectory_errors(one.place, folder / "run") for one in (uncut, merged)]
        placed = f"{_accepted(merged.place)} of {len(cuts)}"
        line = [f"{v:.3f}" for one in errors for v in (one.rmse, one.max)]
        lines.append([world, str(seed), placed, *line, f"{merged.seconds:.0f}"])
    titles = ["world", "seed", "placed", "uncut ATE m", "max m", "merged ATE m", "max m", "s"]
    return markdown(titles, lines)


def _trajectory_errors(result: Path, run: Path) -> ErrorStats:
    estimated = read_trajectory(result / "trajectory.tum")
    true = read_trajectory(run / "truth/trajectory.tum")
    i, j = associate_trajectories(estimated.stamp_s, true.stamp_s, FRAME_DT)
    return compute_absolute_errors(estimated.poses[i], true.poses[j])


if __name__ == "__main__":
    main()
