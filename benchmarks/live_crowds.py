"""Localization in crowds: lost runs and errors against the number of people.

python benchmarks/live_crowds.py --data DIR [--world hall] [--people 0 30 60 120] [--runs 5]
    [--max-range 30]
python benchmarks/live_crowds.py --data DIR --visitors 0 5 10 20 [--max-range 8] [--arrive 20]

Runs of 400 scans through a known map: localized without a prior, with P(static) and with all beams
alike; and by a particle filter with a likelihood field that is told where it starts. Then the same
scans without a map: poses of live mapping, with P(static) and with all beams alike.
people: walk on ways of their own. visitors: gather around the robot after 10 s and stay with it,
0.7 to 2.5 m away, wherever it goes; at once, or with --arrive each after up to so many seconds
more, walking up from 9 to 14 m. Lost: in a known map the last 50 poses are more than 0.5 m off
on average; without one the poses of all scans are, after alignment. NEES: of 3.
"""

import argparse
import math
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
from common import make_parser
from live import build_known_map, normalized_error
from particle_filter import ParticleFilter
from tables import markdown

from stillmap.core import se2
from stillmap.live.mapper import LiveMapper
from stillmap.live.online_slam import OnlineSlam
from stillmap.live.replay import iter_beams
from stillmap.results.eval.trajectory import compute_absolute_errors
from stillmap.results.reader import read_grid
from stillmap.sim import scene_by_name, simulate

_SCANS, _BEFORE_VISITORS = 400, 50
_DISTANCE, _RADIUS = (0.7, 2.5), 0.2  # m, of visitors
_SWAY, _SWAY_SCANS = (0.3, 0.2), 25.0  # rad and m by which they move about, and how slowly
_COME_FROM, _WALK = (9.0, 14.0), 1.3  # m, m/s
_LOST = 0.5  # m


class EveryBeamCounts(OnlineSlam):
    """Without P(static): all beams count alike in matching, and in the map that is matched."""

    def _weigh(self, hits, prior):  # noqa: ARG002
        return hits

    def _add_to_maps(self, observation, e, registered):
        return super()._add_to_maps(observation, np.ones_like(e), registered)

    def _label_again(self, scan):
        return np.ones(len(scan.e), np.float32)


def main() -> None:
    args = _parser().parse_args()
    place = build_known_map(args.data / args.world, args.world)
    is_visited = args.visitors is not None
    lines = []
    for count in args.visitors if is_visited else args.people:
        runs = [_run(args, place, count, is_visited, run) for run in range(args.runs)]
        lines.append([str(count), *map(_summarize, *runs)])
        print(" | ".join(lines[-1]), flush=True)
    known = ["with P(static)", "all alike", "particle filter"]
    titles = [*known, "mapping, with P(static)", "mapping, all alike"]
    print(markdown(["visitors" if is_visited else "people", *titles], lines))


def _parser() -> argparse.ArgumentParser:
    p = make_parser(__doc__)
    p.add_argument("--data", type=Path, required=True, help="folder for maps")
    p.add_argument("--world", default="hall")
    p.add_argument("--people", nargs="+", type=int, default=[0, 30, 60, 120])
    p.add_argument("--visitors", nargs="+", type=int)
    p.add_argument("--arrive", type=float, default=0.0, help="s")
    p.add_argument("--runs", type=int, default=5)
    p.add_argument("--max-range", type=float, default=30.0, help="m")
    p.add_argument("--first-seed", type=int, default=100)
    return p


def _run(args, place, count, is_visited, run):
    """(m off, NEES) of each method, each (T,); infinite while lost."""
    known, T_map_world = place
    changes = {
        "robot": {"scans": _SCANS},
        "laser": {"max_range": args.max_range, "fov": math.pi},
    }
    if not is_visited:
        changes["crowd"] = {"people": count}
    simulation = simulate(scene_by_name(args.world, changes), args.first_seed + run)
    recording, true = simulation.recording, simulation.truth.T_world_base
    if is_visited:
        rng = np.random.default_rng(run)
        recording = add_visitors(recording, count, rng, args.arrive)
    in_map = T_map_world @ true
    return [
        _track(OnlineSlam, recording, in_map, known),
        _track(EveryBeamCounts, recording, in_map, known),
        _filter_particles(known, recording, in_map, run),
        _track(OnlineSlam, recording, true, None),
        _track(EveryBeamCounts, recording, true, None),
    ]


def add_visitors(recording, count: int, rng, arrive: float = 0.0):
    """The recording with people who stay around the robot, within `arrive` s."""
    points, hit = recording.points.copy(), recording.hit.copy()
    bearing, distance = rng.uniform(-np.pi, np.pi, count), rng.uniform(*_DISTANCE, count)
    seconds = 1e-9 * (recording.stamp_ns - recording.stamp_ns[_BEFORE_VISITORS])
    begin = rng.uniform(0.0, arrive, count) if arrive else np.full(count, -np.inf)
    far = rng.uniform(*_COME_FROM, count) if arrive else distance
    sway, kept = np.zeros((2, count)), math.exp(-1.0 / _SWAY_SCANS)
    for t in range(_BEFORE_VISITORS, recording.n_scans):
        shock = rng.normal(size=(2, count)) * np.array(_SWAY)[:, None]
        sway = kept * sway + math.sqrt(1.0 - kept**2) * shock
        walked = _WALK * (seconds[t] - begin)
        angle = bearing + sway[0]
        away = np.maximum(np.maximum(distance, far - walked) + sway[1], 0.5)
        centres = np.stack([away * np.cos(angle), away * np.sin(angle)], axis=1)[walked >= 0.0]
        back = se2.inverse(recording.T_base_sensor[recording.sensor[t]])
        centres = centres @ back[:2, :2].T + back[:2, 2]
        beams = recording.beams_of(t)
        found = _meet(points[beams], centres)
        length = np.linalg.norm(points[beams], axis=1)
        nearer = found < length  # not where a beam is unusable
        noisy = found[nearer] + rng.normal(size=np.count_nonzero(nearer)) * 0.02
        points[beams][nearer] *= (noisy / length[nearer])[:, None].astype(np.float32)
        hit[beams][nearer] = True
    return replace(recording, points=points, hit=hit)


def _meet(points, centres):
    """(N,) m along each beam to the first circle (K, 2); infinite where it meets none."""
    length = np.linalg.norm(points, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        along = (points / length[:, None]) @ centres.T
    off2 = np.square(centres).sum(axis=1) - along**2
    meets = (along > 0.0) & (off2 < _RADIUS**2)
    reach = np.where(meets, along - np.sqrt(np.maximum(_RADIUS**2 - off2, 0.0)), np.inf)
    return reach.min(axis=1, initial=np.inf)


def _track(kind, recording, true, known):
    off, nees = np.full((2, recording.n_scans), math.inf)
    poses = []
    used = mock.patch("stillmap.live.mapper.OnlineSlam", kind)
    with used, LiveMapper({"threads": 1}, place=known) as mapper:
        for t, beams in enumerate(iter_beams(recording)):
            update = mapper.push(beams, recording.T_odom_base[t])
            poses.append(update.pose)
            if known is not None and "lost" not in update.doubts:
                off[t] = np.hypot(*(update.pose - true[t])[:2, 2])
                nees[t] = normalized_error(update, true[t])
    if known is None:
        return np.full(len(true), compute_absolute_errors(np.array(poses), true).rmse), None
    return off, nees


def _filter_particles(known, recording, true, seed: int):
    filter_ = ParticleFilter(read_grid(known), true[0], np.random.default_rng(seed))
    odometry = recording.T_odom_base
    off = np.zeros(recording.n_scans)
    for t, beams in enumerate(iter_beams(recording)):
        increment = np.eye(3) if t == 0 else se2.inverse(odometry[t - 1]) @ odometry[t]
        pose = filter_.push(beams.points, beams.hit, beams.T_base_sensor, increment)
        off[t] = np.hypot(*(pose - true[t])[:2, 2])
    return off, None


def _summarize(*runs) -> str:
    """Lost runs / ATE of the others, m (NEES of them, the median)."""
    lost = [bool(off[-50:].mean() > _LOST) for off, _ in runs]
    kept = [one for one, is_lost in zip(runs, lost, strict=True) if not is_lost]
    if not kept:
        return f"{sum(lost)} / "
    off = np.concatenate([off[np.isfinite(off)] for off, _ in kept])
    out = f"{sum(lost)} / {math.sqrt(np.mean(np.square(off))):.3f}"
    if kept[0][1] is None:
        return out
    nees = np.concatenate([nees[np.isfinite(nees)] for _, nees in kept])
    return f"{out} ({nees.mean():.1f})"


if __name__ == "__main__":
    main()
