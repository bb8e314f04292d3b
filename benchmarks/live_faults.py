"""Faults on a robot while it maps and while it is localized: how long until its pose holds again.

python benchmarks/live_faults.py --data DIR [--world hall] [--runs 10] [--seed 12]
    [--modes map localise]
    [--faults covered dark "no odometry" frozen jumping spinning carried]

Each run begins anywhere in a simulation; after 30 s there are 10 s of a fault, or the robot is
carried 5 to 10 m from one scan to the next, and 40 s without. A robot that maps is carried after
150 s, to where it has been.

covered: all readings are 0.1 m. dark: there are none. no odometry: None. frozen: odometry stands
still, and goes on from there. jumping: it leaps by metres once a second. spinning: the robot stands
where it is, people, too, while odometry goes on at 0.5 m/s.
recovered: runs whose pose is within 0.3 m and 0.1 rad of the truth at the end, without the doubt
"lost"; s: from the end of the fault to the last time that it was not. silent: share of the scans
from the fault on that have no doubt and are off by more than 3 standard deviations and 5 cm (or
0.05 rad). Poses while mapping are compared in the frame of the 30 s before.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import make_parser
from live import build_known_map
from tables import markdown

from stillmap.core import se2
from stillmap.live.mapper import LiveMapper
from stillmap.live.replay import iter_beams
from stillmap.results.eval.trajectory import align
from stillmap.sim import scene_by_name, simulate

_BEFORE, _FAULT, _AFTER = 150, 50, 200  # scans, 5 a second
_MAPPED_BEFORE = 750  # instead, if it is carried while it maps: to a place that it knows
_RATE = 5.0
_CARRIED = 5.0, 10.0  # m
_TOLERANCE = 0.3, 0.1  # m, rad
_SPINNING = se2.matrix(0.1, 0.0, 0.0)  # odometry from scan to scan while the wheels spin
_SLACK = 0.05  # m and rad beside three standard deviations


def cover(beams, T_odom_base, _since, _rng):
    """Every reading is short."""
    length = np.linalg.norm(beams.points, axis=1, keepdims=True)
    points = np.float32(0.1) * beams.points / np.maximum(length, np.float32(1e-3))
    return replace(beams, points=points, hit=np.ones_like(beams.hit)), T_odom_base


def darken(beams, T_odom_base, _since, _rng):
    """No reading at all."""
    nothing = np.full_like(beams.points, np.nan)
    return replace(beams, points=nothing, hit=np.zeros_like(beams.hit)), T_odom_base


def leap(beams, T_odom_base, since, rng):
    """Odometry leaps once a second."""
    if since % round(_RATE) == 0:
        T_odom_base = se2.matrix(*rng.normal(size=3) * (3.0, 3.0, 1.0)) @ T_odom_base
    return beams, T_odom_base


def blur(beams, T_odom_base, _since, rng):
    """The same scan once more, with noise of 1 cm."""
    length = np.linalg.norm(beams.points, axis=1, keepdims=True)
    noise = rng.normal(0.0, 0.01, length.shape) / np.maximum(length, 1e-3)
    return replace(beams, points=(beams.points * (1.0 + noise)).astype(np.float32)), T_odom_base


_FAULTS = {
    "covered": cover,
    "dark": darken,
    "no odometry": lambda beams, *_: (beams, None),
    "frozen": None,
    "jumping": leap,
    "spinning": blur,
    "carried": None,
}


def main() -> None:
    args = _parser().parse_args()
    known, T_map_world = build_known_map(args.data / args.world, args.world, args.map_seed)
    simulation = simulate(scene_by_name(args.world), args.seed)
    lines = []
    for mode in args.modes:
        for fault in args.faults:
            place = None if mode == "map" else (known, T_map_world)
            runs = [_run(simulation, fault, place, number) for number in range(args.runs)]
            lines.append([mode, fault, *_summarize(runs, fault)])
            print(" | ".join(lines[-1]), flush=True)
    print(markdown(["", "fault", "recovered", "s: median", "at most", "silent", "doubts"], lines))


def _parser() -> argparse.ArgumentParser:
    p = make_parser(__doc__)
    p.add_argument("--data", type=Path, required=True, help="folder for maps")
    p.add_argument("--world", default="hall")
    p.add_argument("--runs", type=int, default=10)
    p.add_argument("--seed", type=int, default=12)
    p.add_argument("--map-seed", type=int, default=11, help="of the known map")
    p.add_argument("--modes", nargs="+", default=["map", "localise"], choices=["map", "localise"])
    p.add_argument("--faults", nargs="+", default=list(_FAULTS), choices=list(_FAULTS))
    return p


def _run(simulation, fault, place, number):
    """Errors (T, 2) in m and rad, those that are allowed (T, 2), and doubts of each scan."""
    recording, rng = simulation.recording, np.random.default_rng(number)
    true = simulation.truth.T_world_base
    before = _MAPPED_BEFORE if fault == "carried" and place is None else _BEFORE
    scans = _choose_scans(true, fault, before, rng)
    odometry, beams = recording.T_odom_base, list(iter_beams(recording))
    answers, stamp_ns = [], recording.stamp_ns[scans[0]]
    last, given = odometry[scans[0]], odometry[scans[0]]
    with LiveMapper({"threads": 1}, place=None if place is None else place[0]) as mapper:
        for since, k in enumerate(scans, -before):
            is_fault = 0 <= since < _FAULT
            moved = since > -before and not (fault == "carried" and since == 0)
            if is_fault and fault == "spinning":
                given = given @ _SPINNING
            elif moved and not (is_fault and fault == "frozen"):
                given = given @ se2.inverse(last) @ odometry[k]
            last = odometry[k]
            now = replace(beams[k], stamp_ns=int(stamp_ns)), given
            if is_fault and _FAULTS[fault] is not None:
                now = _FAULTS[fault](*now, since, rng)
            answers.append(mapper.push(*now))
            stamp_ns += round(1e9 / _RATE)
    return _compare(answers, true[scans], before, None if place is None else place[1])


def _choose_scans(true, fault, before, rng):
    """Indices of the scans of a run."""
    length, after = before + _FAULT + _AFTER, _FAULT + _AFTER
    while True:
        first = int(rng.integers(0, len(true) - length))
        scans = np.arange(first, first + length)
        if fault == "spinning":
            return np.concatenate(
                [scans[:before], np.full(_FAULT, before + first), scans[before:-_FAULT]]
            )
        if fault != "carried":
            return scans
        away = np.hypot(*(true[:, :2, 2] - true[first + before, :2, 2]).T)
        there = (away >= _CARRIED[0]) & (away <= _CARRIED[1])
        if before > _BEFORE:  # only where it has been, looking the same way about
            been = true[first : first + before]
            d = se2.parameters(se2.inverse(been)[:, None] @ true[None])
            near = (np.hypot(d[..., 0], d[..., 1]) < 1.0) & (np.abs(d[..., 2]) < 0.8)
            there &= near.any(axis=0)
        there = np.flatnonzero(there[: len(true) - after])
        if len(there):
            to = int(rng.choice(there))
            return np.append(scans[:before], np.arange(to, to + after))


def _compare(answers, true, before, T_map_world):
    poses = np.array([one.pose for one in answers])
    if T_map_world is None:
        T_map_world = align(true[:before], poses[:before])
    d = se2.parameters(se2.inverse(T_map_world @ true) @ poses)
    errors = np.stack([np.hypot(d[:, 0], d[:, 1]), np.abs(d[:, 2])], axis=1)
    covariance = np.array([one.covariance for one in answers])
    variance = [np.linalg.eigvalsh(covariance[:, :2, :2])[:, -1], covariance[:, 2, 2]]
    allowed = 3.0 * np.sqrt(np.stack(variance, axis=1)) + _SLACK
    return errors[before:], allowed[before:], [one.doubts for one in answers[before:]]


def _summarize(runs, fault):
    """Runs that recovered, s until then, silent errors, and what was doubted."""
    seconds, silent, doubted = [], [], set()
    ended = 0 if fault == "carried" else _FAULT
    for errors, allowed, doubts in runs:
        lost = np.array(["lost" in one for one in doubts])
        off = (errors > _TOLERANCE).any(axis=1) | lost
        if not off[-1]:
            last = np.flatnonzero(off)
            seconds.append(max(last[-1] + 1 - ended, 0) / _RATE if len(last) else 0.0)
        sure = np.array([not one for one in doubts])
        silent.append((errors > allowed).any(axis=1) & sure)
        doubted.update(*doubts)
    shown = [f"{np.median(seconds):.1f}", f"{max(seconds):.1f}"] if seconds else ["", ""]
    share = 100.0 * np.concatenate(silent).mean()
    return [f"{len(seconds)} / {len(runs)}", *shown, f"{share:.1f} %", ", ".join(sorted(doubted))]


if __name__ == "__main__":
    main()
