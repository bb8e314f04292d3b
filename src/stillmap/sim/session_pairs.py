"""Pairs of sessions made on purpose: with a given overlap, in two wings, in two buildings."""

import dataclasses
from typing import NamedTuple

import numpy as np

from stillmap.core.errors import InputError
from stillmap.sim.scene import Scene
from stillmap.sim.session_overlap import compute_overlap, observe
from stillmap.sim.session_routes import Region
from stillmap.sim.sessions import SessionOptions, SessionPlan, plan_sessions, simulate_sessions
from stillmap.sim.worlds import scene_by_name

_TRIES = 40  # of two regions, until what they have in common is as wanted
_MARGIN = 6.0  # m around the route that belong to the world
_SMALLEST = 0.3  # of the world's length, each region
_SLACK = 0.02  # of the share, for what people hide
_FAR = 1e3  # m, beyond any world


class OverlapClass(NamedTuple):
    """How much of the second session's hits lie in the area that the first one observed."""

    name: str
    low: float
    high: float


OVERLAPS = (
    OverlapClass("10-30", 0.10, 0.30),
    OverlapClass("30-60", 0.30, 0.60),
    OverlapClass("60-100", 0.60, 1.00),
)


def plan_pair(scene: Scene, overlap: OverlapClass, seed: int = 0) -> SessionPlan:
    """Two sessions in parts of a world, or all of it, which overlap as wanted.

    Raises:
        InputError: no two parts of the world do.
    """
    rng = np.random.default_rng([seed, 7])
    for trial in range(_TRIES):
        regions = _draw_regions(scene, overlap, rng)
        options = SessionOptions(2, regions, odd_sensor=seed % 4 == 0)
        try:
            plan = plan_sessions(scene, options, int(rng.integers(1 << 31)) + trial)
            share = measure_overlap(plan)
        except InputError:  # no room in such a region
            continue
        if overlap.low + _SLACK <= share < overlap.high - _SLACK:
            return plan
    what = f"no two parts of '{scene.name}' overlap by {overlap.name} %"
    raise InputError(what, hint="another seed, or a larger world")


def measure_overlap(plan: SessionPlan) -> float:
    """Share of the hits of the second session that lie where the first one looked.

    Measured without people, who hide some of it.
    """
    empty = tuple(
        dataclasses.replace(
            scene,
            crowd=dataclasses.replace(scene.crowd, people=0),
        )
        for scene in plan.scenes
    )
    sights = [observe(one) for one in simulate_sessions(plan._replace(scenes=empty))]
    return float(compute_overlap(sights, [0] * len(sights))[0, 1])


def plan_wings(seed: int = 0) -> SessionPlan:
    """Two sessions in two wings between which a door is shut."""
    scene = scene_by_name("two-wings")
    shut = tuple(door.leaf(door.closed) for door in scene.leaves)
    scene = dataclasses.replace(scene, walls=(*scene.walls, *shut), leaves=())
    regions = ((0.0, -_FAR, _FAR, _FAR), (-_FAR, -_FAR, -0.15, _FAR))
    if seed % 2:
        regions = regions[::-1]
    return plan_sessions(scene, SessionOptions(2, regions, odd_sensor=False), seed)


def plan_strangers(one: Scene, other: Scene, seed: int = 0) -> tuple[SessionPlan, SessionPlan]:
    """A session each in two places that have nothing in common."""
    options = SessionOptions(1, has_changes=False)
    return plan_sessions(one, options, 2 * seed), plan_sessions(other, options, 2 * seed + 1)


def _draw_regions(
    scene: Scene, overlap: OverlapClass, rng: np.random.Generator
) -> tuple[Region | None, Region | None]:
    """Two parts of the world along its longer side, or along either, the farther apart the less
    they shall overlap; everything where they shall overlap most."""
    line = np.array(scene.route, float)
    (x0, y0), (x1, y1) = line.min(axis=0) - _MARGIN, line.max(axis=0) + _MARGIN
    size, low = np.array([x1 - x0, y1 - y0]), np.array([x0, y0])
    if overlap.high > 0.9 and rng.random() < 0.5:
        return None, None
    axis = int(size.argmax()) if rng.random() < 0.7 else int(rng.integers(2))
    length = rng.uniform(_SMALLEST, 0.7, 2) * size[axis]
    shared = rng.uniform(-0.1, 0.6) * length.min()
    middle = low[axis] + size[axis] / 2 + rng.uniform(-0.1, 0.1) * size[axis]
    first = (middle + shared / 2 - length[0], middle + shared / 2)
    second = (middle - shared / 2, middle - shared / 2 + length[1])
    pair = [_strip(axis, *first), _strip(axis, *second)]
    if rng.random() < 0.5:
        pair.reverse()
    return pair[0], pair[1]


def _strip(axis: int, low: float, high: float) -> Region:
    """Everything between two coordinates along an axis."""
    if axis == 0:
        return (float(low), -_FAR, float(high), _FAR)
    return (-_FAR, float(low), _FAR, float(high))
