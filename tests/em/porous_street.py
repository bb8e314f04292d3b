"""A street with what lets some beams pass: a hedge, a fence of thin posts, a car with windows."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from stillmap import Recording

SENSOR_HEIGHT, SPEED = 1.5, 0.9  # m above the ground, m/s along x
HEDGE, POST, CAR, WALKER, SOLID = range(5)

_WALL = 9.0  # m to the wall behind all, along y
_PERIOD = 0.1  # s
_LEAVES = 2.0  # m that beams travel among the leaves of a hedge of 0.7 m, on average


@dataclass(frozen=True, eq=False)
class Street:
    """Attributes: the recording, poses (T, 4, 4), what each beam ended on (M,)."""

    recording: Recording
    poses: Any
    thing: Any


def watch(sweeps: int = 80, seed: int = 0) -> Street:
    """Sweeps of a lidar that drives along the street, while somebody walks before the hedge."""
    rng = np.random.default_rng(seed)
    direction = _directions()
    poses = np.tile(np.eye(4), (sweeps, 1, 1))
    poses[:, 0, 3] = SPEED * _PERIOD * np.arange(sweeps)
    poses[:, 2, 3] = SENSOR_HEIGHT
    clouds, things = [], []
    for t, T in enumerate(poses):
        ranges, thing = _cast(T[:3, 3], direction, t * _PERIOD, rng)
        noisy = ranges + rng.normal(scale=0.01, size=len(ranges))
        clouds.append((noisy[:, None] * direction).astype(np.float32))
        things.append(thing)
    recording = Recording.from_clouds(_PERIOD * np.arange(sweeps), clouds)
    return Street(recording, poses, np.concatenate(things))


def _directions() -> Any:
    azimuth = np.radians(90.0 + np.arange(-60.0, 60.5, 0.75))
    elevation = np.radians(np.arange(-20.0, 3.0, 1.0))
    a, e = (grid.ravel() for grid in np.meshgrid(azimuth, elevation))
    return np.column_stack([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])


def _cast(start: Any, direction: Any, time: float, rng: np.random.Generator) -> tuple[Any, Any]:
    """(N,) ranges in metres, and what beams of these directions (N, 3) end on."""
    n = len(direction)
    with np.errstate(divide="ignore"):
        to_ground = np.where(direction[:, 2] < 0, -start[2] / direction[:, 2], np.inf)
    ranges, thing = np.minimum(to_ground, (_WALL - start[1]) / direction[:, 1]), np.full(n, SOLID)

    def meet(distance: Any, what: int) -> None:
        nearer = distance < ranges
        ranges[nearer], thing[nearer] = distance[nearer], what

    low, high = _cross_box(start, direction, (-6.0, 4.0, 0.0), (1.0, 4.7, 1.3))
    inside = low + rng.exponential(_LEAVES, n)
    meet(np.where(inside < high, inside, np.inf), HEDGE)
    for x in np.arange(1.5, 4.0, 0.5):
        meet(_cross_cylinder(start, direction, (x, 4.3), 0.025, 1.2), POST)
    _cast_car(start, direction, rng, meet)
    walker = (-3.0 + 1.3 * time, 3.0)
    meet(_cross_cylinder(start, direction, walker, 0.25, 1.7), WALKER)
    return ranges, thing


def _cast_car(start: Any, direction: Any, rng: np.random.Generator, meet: Any) -> None:
    """A body to 0.8 m, and above it windows, of which four beams in ten come back."""
    low, high = _cross_box(start, direction, (5.0, 4.0, 0.2), (9.0, 5.7, 0.8))
    meet(np.where(low < high, low, np.inf), SOLID)
    low, high = _cross_box(start, direction, (5.5, 4.1, 0.8), (8.5, 5.6, 1.4))
    inside = low + np.where(rng.random(len(low)) < 0.4, 0.0, rng.exponential(1.0, len(low)))
    meet(np.where(inside < high, inside, np.inf), CAR)


def _cross_box(start: Any, direction: Any, lower: Any, upper: Any) -> tuple[Any, Any]:
    """Ranges (N,) at which beams enter and leave a box; where they miss it, enter after leaving."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([(np.asarray(corner) - start) / direction for corner in (lower, upper)])
    low, high = ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)
    return np.where(low > 0, low, np.inf), high


def _cross_cylinder(start: Any, direction: Any, at: Any, radius: float, height: float) -> Any:
    """Ranges (N,) at which beams meet an upright cylinder; inf: they do not."""
    to, d = np.asarray(at) - start[:2], direction[:, :2]
    length = np.linalg.norm(d, axis=1)
    along = d @ to / length
    depth = radius**2 - (to @ to - along**2)
    distance = (along - np.sqrt(np.maximum(depth, 0.0))) / length
    meets = (depth > 0) & (along > 0) & (start[2] + distance * direction[:, 2] < height)
    return np.where(meets, distance, np.inf)
