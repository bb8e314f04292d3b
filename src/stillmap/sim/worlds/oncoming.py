"""A bending road with one lane each way: the robot drives down it once, against the traffic."""

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from stillmap.sim.options import CrowdOptions, TrafficOptions
from stillmap.sim.scene import Lane, Point, Scene, Segment
from stillmap.sim.walls import box, pillar, polyline
from stillmap.sim.worlds.street import make_street_scene

Float = NDArray[np.float64]

_LANE = 1.75  # m from the middle of the road to the middles of its lanes
_PARKED, _KERB, _TREES, _FRONT = 4.7, 5.9, 6.7, 9.5  # m from there; two rows of houses
_LENGTH, _BEYOND = 260.0, 150.0  # m, of the street; lanes go on at both ends
_SWAY, _BEND = 9.0, 190.0  # m, amplitude and length of the bends


def street_oncoming() -> Scene:
    """A road of 260 m that bends: cars come head-on, their bearing hardly changes for seconds.

    The robot drives at 6 m/s and turns nowhere: most places are seen for some seconds, from far.
    """
    rng = np.random.default_rng(41)
    route = _offset(np.arange(6.0, _LENGTH - 15.0, 5.0), -_LANE)
    lane = _offset(np.arange(_LENGTH + _BEYOND, -_BEYOND - 1.0, -5.0), _LANE)
    along = np.arange(0.0, _LENGTH + 1.0, 5.0)
    kerbs = [s for side in (-1, 1) for s in polyline(_points(_offset(along, side * _KERB)))]
    across = [_points(_offset(np.full(2, x), np.array([-_FRONT, _FRONT]))) for x in (0.0, _LENGTH)]
    people_at = (_offset(np.array([20.0]), side * (_FRONT - 1.6)) for side in (-1, 1))
    scene = make_street_scene(
        name="street-oncoming",
        walls=tuple(_houses(rng) + _roadside(rng)),
        route=tuple(_points(route)),
        kerbs=(*kerbs, *(segment for line in across for segment in polyline(line))),
        people_at=tuple(_points(np.concatenate(list(people_at)))),
        lanes=(Lane(tuple(_points(lane))),),
        crowd=CrowdOptions(people=6),
        traffic=TrafficOptions(vehicles=16, stopping_share=0.0),
    )
    return dataclasses.replace(scene, robot=dataclasses.replace(scene.robot, speed=6.0))


def _offset(x: Float, off: float | Float) -> Float:
    """(n, 2) places `off` metres to the left of the middle of the road at x."""
    phase = 2.0 * math.pi / _BEND
    slope = _SWAY * phase * np.cos(phase * x)
    norm = np.hypot(1.0, slope)
    return np.column_stack([x - off * slope / norm, _SWAY * np.sin(phase * x) + off / norm])


def _points(xy: Float) -> list[Point]:
    return [(float(x), float(y)) for x, y in xy]


def _heading(x: float) -> float:
    phase = 2.0 * math.pi / _BEND
    return math.atan(_SWAY * phase * math.cos(phase * x))


def _houses(rng: np.random.Generator) -> list[Segment]:
    """Houses of different widths along both sides, some apart from the next, and both ends shut."""
    walls: list[Segment] = []
    for side in (-1, 1):
        at = -10.0
        while at < _LENGTH + 10.0:
            width, back = float(rng.uniform(8.0, 20.0)), float(rng.uniform(0.0, 0.8))
            ((x, y),) = _offset(np.array([at + width / 2]), side * (_FRONT + back + 3.0)).tolist()
            walls += box(x, y, width, 6.0, _heading(at + width / 2))
            at += width + float(rng.choice([0.0, 0.0, 3.0, 5.0]))
    return walls


def _roadside(rng: np.random.Generator) -> list[Segment]:
    """Trees, lamps and parked cars on both sides."""
    walls: list[Segment] = []
    for side in (-1, 1):
        for k, at in enumerate(np.arange(4.0, _LENGTH, 11.0)):
            radius = 0.08 if k % 3 == 2 else float(rng.uniform(0.12, 0.3))
            ((x, y),) = _offset(np.array([at + rng.uniform(-0.4, 0.4)]), side * _TREES).tolist()
            walls += pillar(x, y, radius, 8)
        for at in np.arange(6.0, _LENGTH, 6.3):
            if rng.random() < 0.5:
                length, width = rng.uniform((4.0, 1.7), (4.9, 1.9)).tolist()
                ((x, y),) = _offset(np.array([at]), side * _PARKED).tolist()
                walls += box(x, y, length, width, _heading(float(at)))
    return walls
