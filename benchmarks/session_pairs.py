"""Pairs of sessions made on purpose: with a given overlap, in two wings, in two buildings."""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from session_overlap import compute_overlap, observe

from stillmap.core.array_types import Float
from stillmap.core.errors import InputError
from stillmap.sim import Scene, scene_by_name
from stillmap.sim.sessions import (
    DrawRoute,
    SessionPlan,
    draw_tour,
    find_free_parts,
    plan_sessions,
    simulate_sessions,
)
from stillmap.sim.walls import polyline

Region = tuple[float, float, float, float]  # x0, y0, x1, y1 in metres

_STARTS, _HALVINGS = 8, 7  # of two regions, and of what they share until it is as wanted
_APART = -0.6  # of the shorter one's length, when they share least
_MARGIN = 6.0  # m around the route that belong to the world
_LENGTHS = (0.35, 0.75)  # of the world's, of each region
_SLACK = 0.02  # of the share, for what people hide
_FAR = 1e3  # m, beyond any world
_ANCHORS = 12  # random points of a region, the largest part around which the robot explores


class OverlapClass(NamedTuple):
    """Share of the second session's hits in the area that the first one observed."""

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
    for _ in range(_STARTS):
        strips = _Strips.draw(scene, rng)
        own = int(rng.integers(1 << 31))
        low, high = _APART, 1.0
        for _ in range(_HALVINGS):
            shared = rng.uniform(0.3, 0.7) * (high - low) + low
            routes = [stay_within(region) for region in strips.regions(shared)]
            try:
                plan = plan_sessions(scene, 2, own, routes=routes, has_odd_sensor=seed % 4 == 0)
                share = measure_overlap(plan)
            except InputError:  # no room in such a region
                break
            fits = overlap.low + _SLACK <= share < overlap.high - _SLACK
            if fits and overlap.low <= measure_overlap(plan, with_people=True) < overlap.high:
                return plan
            low, high = (shared, high) if share < overlap.low + _SLACK else (low, shared)
    what = f"no two parts of '{scene.name}' overlap by {overlap.name} %"
    raise InputError(what, hint="another seed, or a larger world")


def measure_overlap(plan: SessionPlan, with_people: bool = False) -> float:
    """Share of the hits of the second session that lie where the first one looked.

    Without people, who hide some of it, it takes half the time.
    """
    if not with_people:
        crowds = [dataclasses.replace(scene.crowd, people=0) for scene in plan.scenes]
        pairs = zip(plan.scenes, crowds, strict=True)
        plan = plan._replace(scenes=[dataclasses.replace(s, crowd=c) for s, c in pairs])
    sights = [observe(made.recording, made.truth) for made in simulate_sessions(plan)]
    return float(compute_overlap(sights, [0] * len(sights))[0, 1])


def plan_wings(seed: int = 0, changes: Mapping[str, Any] | None = None) -> SessionPlan:
    """Two sessions in two wings between which a door is shut; `changes` as of `scene_by_name`."""
    scene = scene_by_name("two-wings", changes)
    shut = tuple(door.leaf(door.closed) for door in scene.leaves)
    scene = dataclasses.replace(scene, walls=(*scene.walls, *shut), leaves=())
    regions = ((0.0, -_FAR, _FAR, _FAR), (-_FAR, -_FAR, -0.15, _FAR))
    if seed % 2:
        regions = regions[::-1]
    routes = [stay_within(region) for region in regions]
    return plan_sessions(scene, 2, seed, routes=routes, has_odd_sensor=False)


def plan_strangers(one: Scene, other: Scene, seed: int = 0) -> tuple[SessionPlan, SessionPlan]:
    """A session each in two places that have nothing in common."""
    return plan_sessions(one, 1, 2 * seed), plan_sessions(other, 1, 2 * seed + 1)


def stay_within(region: Region) -> DrawRoute:
    """Tours of a region, around which a fence stands that no laser sees."""

    def draw(scene: Scene, length: float, rng: np.random.Generator) -> Scene:
        parts = find_free_parts(scene, np.array(scene.route, float))
        nodes = np.concatenate([np.empty((0, 2)), *(part.point(part.nodes) for part in parts)])
        nodes = nodes[is_within(nodes, region)]
        if not len(nodes):
            raise InputError("the robot finds no room in its region", hint="another region")
        anchors = nodes[rng.integers(len(nodes), size=_ANCHORS)]
        ends = np.reshape(scene.walls, (-1, 2)).astype(float)
        x0, y0 = np.maximum(region[:2], ends.min(axis=0)).tolist()
        x1, y1 = np.minimum(region[2:], ends.max(axis=0)).tolist()
        fence = polyline([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], closed=True)
        scene = dataclasses.replace(scene, kerbs=(*scene.kerbs, *fence))
        return draw_tour(scene, length, rng, anchors)

    return draw


def is_within(points: Float, region: Region) -> NDArray[np.bool_]:
    """(N,) whether points (N, 2) lie in a region."""
    return np.all((points > region[:2]) & (points < region[2:]), axis=1)


class _Strips(NamedTuple):
    """Two parts of a world side by side along an axis: its middle, their lengths, their order."""

    axis: int
    middle: float
    lengths: tuple[float, float]
    reverse: bool

    @classmethod
    def draw(cls, scene: Scene, rng: np.random.Generator) -> "_Strips":
        """Most often along the longer side of the world."""
        line = np.array(scene.route, float)
        low, size = line.min(axis=0) - _MARGIN, np.ptp(line, axis=0) + 2 * _MARGIN
        axis = int(size.argmax()) if rng.random() < 0.7 else int(rng.integers(2))
        lengths = rng.uniform(*_LENGTHS, 2) * size[axis]
        middle = low[axis] + size[axis] * rng.uniform(0.4, 0.6)
        return cls(axis, float(middle), (lengths[0], lengths[1]), bool(rng.random() < 0.5))

    def regions(self, shared: float) -> tuple[Region, Region]:
        """The two parts, when they share so much of the shorter one; negative: they are apart."""
        half = shared * min(self.lengths) / 2
        first = (self.middle + half - self.lengths[0], self.middle + half)
        second = (self.middle - half, self.middle - half + self.lengths[1])
        pair = (_strip(self.axis, *first), _strip(self.axis, *second))
        return (pair[1], pair[0]) if self.reverse else pair


def _strip(axis: int, low: float, high: float) -> Region:
    """Everything between two coordinates along an axis."""
    if axis == 0:
        return (float(low), -_FAR, float(high), _FAR)
    return (-_FAR, float(low), _FAR, float(high))
