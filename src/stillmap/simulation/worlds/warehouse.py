"""A warehouse: racks and pallets of all sizes, thin posts, narrow aisles, forklifts."""

import math

import numpy as np

from stillmap.simulation.lidar_options import HeightOptions
from stillmap.simulation.options import CrowdOptions, TrafficOptions
from stillmap.simulation.scene import Lane, Point, Scene, Segment
from stillmap.simulation.walls import Opening, box, pillar, wall

_LAYOUT_SEED = 12  # what stands where is part of the world, not of the recording
RACKS = (2.6, 6.0, 9.2, 12.6, 15.8)  # m, y of the middles of the rows
BLOCKS = ((5.0, 22.6), (25.4, 43.0))  # m, x from where to where racks stand
BAY = 2.2  # m between two posts of a rack
_DEPTH = 1.1  # m, of a rack


def warehouse(people: int = 12) -> Scene:
    """A warehouse of 50 x 30 m; forklifts drive round in a lane along the north wall."""
    rng = np.random.default_rng(_LAYOUT_SEED)
    docks = [Opening(x, 3.0, 0.6) for x in (6.0, 16.0, 26.0, 36.0)]
    walls = [
        *wall((0, 0), 50, "south", [Opening(9.0, 1.2), Opening(31.0, 4.0, 0.4)]),
        *wall((0, 30), 50, "north", docks),
        *wall((0, 0), 30, "west", [Opening(12.0, 1.2), Opening(20.0, 2.0, 0.5)]),
        *wall((50, 0), 30, "east", [Opening(5.0, 1.2), Opening(18.5, 1.2)]),
    ]
    for y in RACKS:
        for low, high in BLOCKS:
            walls += _rack(low, high, y, rng)
    walls += _stacks(rng)
    for x in (12.5, 24.0, 36.0):
        walls += box(x, 24.2, 0.4, 0.4)
    aisles: list[Point] = [(2.4, 4.3), (23.9, 4.3), (47, 4.3), (47, 7.6), (23.9, 7.6), (2.4, 7.6)]
    more: list[Point] = [(2.4, 10.9), (23.9, 10.9), (47, 10.9), (47, 14.2), (23.9, 14.2)]
    home: list[Point] = [(2.4, 14.2), (2.4, 22.5), (24.2, 22.8), (46.5, 23.4), (47, 17.6)]
    return Scene(
        name="warehouse",
        walls=tuple(walls),
        route=(*aisles, *more, *home, (23.9, 17.5), (23.9, 11.0)),
        kerbs=((0.0, 25.0, 50.0, 25.0),),
        lanes=(Lane(_circuit(3.0, 47.0, 26.3, 28.5), "forklift"),),
        crowd=CrowdOptions(people=people),
        heights=HeightOptions(ceiling=7.0),
        traffic=TrafficOptions(
            vehicles=2, min_speed=1.6, max_speed=2.4, stopping_share=1.0, max_stop=20.0
        ),
    )


def _rack(low: float, high: float, y: float, rng: np.random.Generator) -> list[Segment]:
    """Posts of 2 to 5 cm radius along both sides, and what the lowest shelf holds between them."""
    walls: list[Segment] = []
    bays = round((high - low) / BAY)
    for k in range(bays + 1):
        x = low + k * BAY
        for side in (-1, 1):
            walls += pillar(x, y + side * _DEPTH / 2, rng.uniform(0.02, 0.05), 6)
        if k == bays or rng.random() < 0.15:
            continue
        middle = x + BAY / 2
        if rng.random() < 0.55:
            width, height = rng.uniform((1.0, 0.7), (1.8, 1.0)).tolist()
            shift, angle = rng.uniform(-0.05, 0.05, 2).tolist()
            walls += box(middle, y + shift, width, height, angle)
            continue
        for half in (-0.5, 0.5):
            width, height = rng.uniform(0.3, 0.75, 2).tolist()
            dx, dy, angle = rng.uniform((-0.12, -0.12, -0.4), (0.12, 0.12, 0.4)).tolist()
            walls += box(middle + half + dx, y + dy, width, height, angle)
    return walls


def _stacks(rng: np.random.Generator) -> list[Segment]:
    """Pallets set down anyhow between the racks and the forklifts' lane, and rolls on end."""
    walls: list[Segment] = []
    taken: list[tuple[float, float]] = []
    for _ in range(400):
        x, y = float(rng.uniform(4.0, 45.0)), float(rng.uniform(18.9, 21.4))
        if abs(x - 23.9) < 1.6 or any(math.hypot(x - u, y - v) < 2.0 for u, v in taken):
            continue
        taken.append((x, y))
        if rng.random() < 0.25:
            walls += pillar(x, y, rng.uniform(0.1, 0.45), 10)
        else:
            width, height = rng.uniform(0.4, 1.3, 2).tolist()
            walls += box(x, y, width, height, rng.uniform(-math.pi, math.pi))
    return walls


def _circuit(west: float, east: float, south: float, north: float) -> tuple[Point, ...]:
    """Round and round, with half circles at the ends."""
    radius, middle = (north - south) / 2, (north + south) / 2
    turns = [math.pi * k / 12 for k in range(13)]
    right = [(east + radius * math.sin(a), middle - radius * math.cos(a)) for a in turns]
    left = [(west - radius * math.sin(a), middle + radius * math.cos(a)) for a in turns]
    return (*right, *left, right[0])
