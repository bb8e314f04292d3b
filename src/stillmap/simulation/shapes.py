"""The parts of cars, people, trees and the like, about their middles; metres."""

import math

from stillmap.simulation.lidar_options import HeightOptions
from stillmap.simulation.solids import BOX, CYLINDER, ELLIPSOID, Part

VAN = 5.2  # m, cars that are longer are vans
LEAF = 0.04  # m, how thick doors are
_THIN = 0.2  # m, furniture that is thinner is a panel
_LEG = 0.1  # m, what is smaller is the leg of a chair
_SEAT = 0.45  # m
_LAMP, _LAMP_RADIUS = 6.0, 0.1  # m, posts that are thinner are of lamps
_CROWN = 9.0  # times as wide as its trunk
_WIDEST = 7.0  # m, half of what a crown measures
_BRANCHES = 2.3  # m, where crowns begin


def vehicle(length: float, width: float, kind: str) -> list[Part]:
    """A car, a van or a forklift that heads along its length."""
    if kind == "forklift":
        return _forklift(length, width)
    half = width / 2
    wheels = [
        Part(BOX, i * 0.31 * length, j * (half - 0.12), (0.3, 0.1), (0.0, 0.6))
        for i in (-1, 1)
        for j in (-1, 1)
    ]
    if length > VAN:
        body = Part(BOX, 0.0, 0.0, (length / 2, half), (0.3, 1.1))
        return [body, Part(BOX, -0.09 * length, 0.0, (0.41 * length, half), (1.1, 2.1)), *wheels]
    body = Part(BOX, 0.0, 0.0, (length / 2, half), (0.22, 0.88))
    cabin = Part(BOX, -0.06 * length, 0.0, (0.29 * length, 0.88 * half), (0.88, 1.48))
    return [body, cabin, *wheels]


def _forklift(length: float, width: float) -> list[Part]:
    half, rear = width / 2, -0.17 * length
    mast = Part(BOX, 0.19 * length, 0.0, (0.04 * length, 0.7 * half), (0.05, 2.2))
    forks = [Part(BOX, 0.36 * length, j * 0.3, (0.14 * length, 0.06), (0.04, 0.1)) for j in (-1, 1)]
    roof = Part(BOX, rear, 0.0, (0.2 * length, 0.85 * half), (2.05, 2.12))
    posts = [
        Part(CYLINDER, rear + i * 0.18 * length, j * 0.75 * half, (0.03, 0.03), (1.1, 2.05))
        for i in (-1, 1)
        for j in (-1, 1)
    ]
    body = Part(BOX, rear, 0.0, (0.33 * length, half), (0.1, 1.1))
    return [body, mast, roof, *forks, *posts]


def leg(half: tuple[float, float], tall: float) -> list[Part]:
    """One leg of a person so many metres tall."""
    return [Part(CYLINDER, 0.0, 0.0, half, (0.0, 0.48 * tall))]


def torso_and_head(half: tuple[float, float], tall: float) -> list[Part]:
    """What is above the legs."""
    torso = Part(CYLINDER, 0.0, 0.0, half, (0.46 * tall, 0.83 * tall))
    return [torso, Part(ELLIPSOID, 0.02, 0.0, (0.1, 0.08), (0.84 * tall, tall))]


def door(width: float, height: float) -> list[Part]:
    """A leaf."""
    return [Part(BOX, 0.0, 0.0, (width / 2, LEAF / 2), (0.01, height))]


def boxed(length: float, width: float, heights: HeightOptions) -> list[Part]:
    """What is drawn as a box with sides along and across its heading.

    Under the open sky what measures as much as a car is one; else it is furniture.
    """
    if heights.ceiling is None and 3.8 <= length <= 6.0 and 1.5 <= width <= 2.3:
        return vehicle(length, width, "car")
    if max(length, width) < _LEG:
        top = _SEAT
    else:
        top = heights.panels if min(length, width) < _THIN else heights.furniture
    return [Part(BOX, 0.0, 0.0, (length / 2, width / 2), (0.0, min(top, heights.top)))]


def round_thing(radius: float, heights: HeightOptions) -> list[Part]:
    """What is drawn as a circle: a column; under the open sky a lamp post, or a tree."""
    around = (radius, radius)
    if heights.ceiling is not None:
        return [Part(CYLINDER, 0.0, 0.0, around, (0.0, heights.ceiling))]
    if radius < _LAMP_RADIUS:
        lamp = Part(BOX, 0.0, 0.0, (0.35, 0.12), (_LAMP, _LAMP + 0.15))
        return [Part(CYLINDER, 0.0, 0.0, around, (0.0, _LAMP)), lamp]
    crown = min(_CROWN * radius, _WIDEST)
    tall = _BRANCHES + math.sqrt(crown) * 2.0
    trunk = Part(CYLINDER, 0.0, 0.0, around, (0.0, _BRANCHES + 0.5))
    return [trunk, Part(ELLIPSOID, 0.0, 0.0, (crown, crown), (_BRANCHES, tall))]
