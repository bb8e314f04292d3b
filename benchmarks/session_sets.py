"""Sets of sessions for benchmarks: simulated once, kept in a folder, and read from there after."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from session_pairs import OVERLAPS, plan_pair, plan_strangers, plan_wings

from stillmap.core.errors import InputError
from stillmap.sim import scene_by_name
from stillmap.sim.sessions import SessionPlan, draw_piece, plan_sessions, write_sessions

# most robots see to their sides: beams, rad
LASER = {"laser": {"beams": 270, "fov": math.radians(270)}}
NEGATIVES = ("wings", "lookalike")
WORLDS = ("office", "corridor", "warehouse", "hall")

# of a street: ways of the sessions after the first one
STRETCHES = ("same way", "25 m on", "opposite", "opposite, 25 m on")
_STREET = {"lidar": {"channels": 16, "columns": 400}, "robot": {"scans": 100}}
_DRIVEN, _ON = 50.0, 25.0  # m of a session, and by which one begins after another
_TURN = 17.4  # m in which the routes of the streets turn back

Plan = Callable[[], tuple[SessionPlan, ...]]


@dataclass(frozen=True)
class PairSet:
    """Two sessions on disk: the kind of pair, its world and its seed."""

    kind: str
    world: str
    seed: int
    folder: Path


def prepare(folder: Path, plan: Plan, seed: int) -> Path:
    """The folder, with sessions that are simulated unless they are there already."""
    if not (folder / "sessions.json").exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        write_sessions(plan(), folder, seed=seed)
    return folder


def prepare_pairs(data: Path, seeds: range) -> list[PairSet]:
    """Pairs of each world and class of overlap, and negatives; worlds without such a pair have
    none."""
    pairs = []
    for seed in seeds:
        for world in WORLDS:
            for overlap in OVERLAPS:
                folder = data / f"pair-{world}-{overlap.name}-{seed}"

                def plan(world=world, overlap=overlap, seed=seed):
                    return (plan_pair(scene_by_name(world, LASER), overlap, seed),)

                try:
                    prepare(folder, plan, seed)
                except InputError:
                    continue
                pairs.append(PairSet(f"{overlap.name} %", world, seed, folder))
        for kind in NEGATIVES:
            folder = prepare(data / f"negative-{kind}-{seed}", _negative(kind, seed), seed)
            pairs.append(PairSet(kind, kind, seed, folder))
    return pairs


def _negative(kind: str, seed: int) -> Plan:
    if kind == "wings":
        return lambda: (plan_wings(seed, LASER),)
    scenes = [scene_by_name(f"lookalike-{k}", LASER) for k in (1, 2)]
    return lambda: plan_strangers(*scenes, seed)


def prepare_days(
    data: Path,
    world: str,
    count: int,
    seed: int,
    scans: int | None = None,
    people: int | None = None,
) -> Path:
    """`count` sessions of a world."""
    changes = LASER if scans is None else {**LASER, "robot": {"scans": scans}}
    changes = changes if people is None else {**changes, "crowd": {"people": people}}

    def plan():
        return (plan_sessions(scene_by_name(world, changes), count, seed),)

    what = f"{world}-{count}-{scans or 'all'}-{'usual' if people is None else people}-{seed}"
    return prepare(data / f"days-{what}", plan, seed)


def prepare_street(data: Path, name: str, seed: int) -> Path:
    """Five sessions of a street that the route follows there and back, see `STRETCHES`."""
    scene = scene_by_name(name, _STREET)
    steps = np.diff(np.array(scene.route, float), axis=0)
    length = float(np.hypot(*steps.T).sum())
    there = (length - _TURN) / 2
    first = float(np.random.default_rng(seed).uniform(0.0, there - _DRIVEN - 30.0))
    back = length + 2.0 - first - _DRIVEN  # the same stretch, on the way back
    begins = (first, first, first + _ON, back, back - _ON)

    def plan():
        routes = [partial(draw_piece, begin=begin) for begin in begins]
        return (plan_sessions(scene, 5, seed, routes=routes),)

    return prepare(data / f"{name}-{seed}", plan, seed)
