"""Synthetic recordings: walls, with objects and walkers in front of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from recordings import of_one_sensor

from stillmap import _core, em
from stillmap.core.recording import Recording

RESOLUTION = 0.1
FAR = 30.0  # metres: maximum range


@dataclass(frozen=True)
class Ball:
    """Something round that stands in a place for a while."""

    x: float
    y: float
    since: float  # seconds
    until: float
    radius: float = 0.25

    def ranges(self, origin: Any, directions: Any) -> Any:
        off = np.zeros_like(origin)
        off[:2] = self.x, self.y
        off = off - origin
        along = directions @ off
        depth = self.radius**2 - off @ off + along**2
        near = along - np.sqrt(np.maximum(depth, 0.0))
        return np.where((depth > 0) & (near > 0), near, np.inf)


@dataclass(frozen=True)
class Wall:
    """The half space beyond normal . x = distance ends beams, within `width` of its foot."""

    normal: Sequence[float]
    distance: float
    width: float = np.inf

    def ranges(self, origin: Any, directions: Any) -> Any:
        n = np.array(self.normal, float) / np.linalg.norm(self.normal)
        with np.errstate(divide="ignore", invalid="ignore"):
            r = (self.distance - origin @ n) / (directions @ n)
            beside = origin + directions * r[:, None] - n * self.distance
        inside = np.linalg.norm(beside, axis=1) <= self.width
        return np.where((r > 0) & inside, r, np.inf)


def fan(beams: int = 181, width: float = 180.0) -> Any:
    """(beams, 2) directions about the x axis."""
    a = np.radians(np.linspace(-width / 2, width / 2, beams))
    return np.column_stack([np.cos(a), np.sin(a)])


def cone(side: int = 25, width: float = 90.0) -> Any:
    """(side^2, 3) directions about the x axis."""
    t = np.tan(np.radians(np.linspace(-width / 2, width / 2, side)))
    y, z = np.meshgrid(t, t)
    u = np.column_stack([np.ones(y.size), y.ravel(), z.ravel()])
    return u / np.linalg.norm(u, axis=1, keepdims=True)


ROOM = (Wall((1, 0), 4.03), Wall((0, 1), 3.04), Wall((0, -1), 3.04))


def passing(since: float, x: float = 1.5) -> list[Ball]:
    """Walks past along y, each second in another place."""
    return [Ball(x, -2.4 + k, since + k, since + k + 1) for k in range(5)]


def at(m: em.OccupancyMap, points: Any, layer: Any = None) -> Any:
    """p_occupied, or a layer like it, where these points lie; NaN outside."""
    first = np.round(np.array(m.origin[:2]) / m.resolution).astype(int)
    values = np.asarray(m.p_occupied if layer is None else layer, float)
    padded = np.pad(values, 1, constant_values=np.nan)
    column, row = (np.floor(np.asarray(points) / m.resolution).astype(int) - first + 1).T
    return padded[np.clip(row, 0, len(padded) - 1), np.clip(column, 0, padded.shape[1] - 1)]


@dataclass(frozen=True)
class Watched:
    """A recording from one position, and what reflected each beam."""

    recording: Recording
    what: Any  # (M,) number of the wall or ball, -1: nothing

    @property
    def poses(self) -> Any:
        D = self.recording.dimension
        return np.tile(np.eye(D + 1), (self.recording.n_scans, 1, 1))

    def grid(self, e: Any = None) -> Any:
        """The sums of (10); every hit counts as static without e."""
        D = self.recording.dimension
        grid = (_core.OccupancyGrid2D, _core.OccupancyGrid3D)[D - 2](RESOLUTION)
        if D == 2:
            em.add_recording(grid, self.recording, self.poses, e)
        return grid

    def e_step(self, estimator: em.Estimator = "stillmap", **options: Any) -> em.EStepResult:
        chosen = em.EmOptions(**options)
        return em.e_step(self.recording, self.poses, self.grid(), estimator, chosen)

    def of(self, values: Any, *what: int) -> Any:
        """The values of the beams that these walls or balls reflected."""
        return values[np.isin(self.what, what)]


def watch(
    things: Sequence[Wall | Ball],
    seconds: float = 60.0,
    directions: Any = None,  # (n, D), or what gives them at a time
    *,
    noise: float = 0.01,
) -> Watched:
    """Watches walls and balls from the origin, once a second."""
    rng = np.random.default_rng(0)
    looking = directions if callable(directions) else lambda _: directions
    directions = fan() if directions is None else directions
    times = np.arange(0.0, seconds)
    points, what = [], []
    for t in times:
        u = looking(t)
        ranges = np.full((len(things) + 1, len(u)), np.inf)  # the last: nothing
        for i, thing in enumerate(things):
            if isinstance(thing, Wall) or thing.since <= t < thing.until:
                ranges[i] = thing.ranges(np.zeros(u.shape[1]), u)
        nearest = ranges.argmin(axis=0)
        r = ranges.min(axis=0)
        seen = r < FAR
        what.append(np.where(seen, nearest, -1))
        r = np.where(seen, r + rng.normal(scale=noise, size=len(u)), FAR)
        points.append(u * r[:, None])
    what_hit = np.concatenate(what)
    recording = of_one_sensor(
        np.round(times * 1e9).astype(np.int64),
        np.cumsum([0, *map(len, points)]),
        np.concatenate(points).astype(np.float32),
        what_hit >= 0,
    )
    return Watched(recording, what_hit)


ANGLES = np.radians(np.arange(-90.0, 91.0))
WALL = 6.0  # metres ahead


def recording_of(ranges: Any, seconds: Any = None) -> Recording:
    """Scans of 181 beams from the origin; inf: nothing came back, nan: unusable."""
    ranges = np.atleast_2d(np.asarray(ranges, float))
    T, N = ranges.shape
    seconds = 0.2 * np.arange(T) if seconds is None else np.asarray(seconds)
    points = np.where(np.isinf(ranges), 20.0, ranges)[..., None] * fan()
    return of_one_sensor(
        np.round(1e9 * seconds).astype(np.int64),
        N * np.arange(T + 1),
        points.reshape(-1, 2).astype(np.float32),
        np.isfinite(ranges).ravel(),
    )


def at_origin(recording: Recording) -> Any:
    return np.tile(np.eye(3), (recording.n_scans, 1, 1))


def wall() -> Any:
    """(181,) metres to a wall across the way ahead, 10 m where it is farther than that."""
    return np.minimum(Wall((1, 0), WALL).ranges(np.zeros(2), fan()), 10.0)


def before(ranges: Any, *balls: tuple[float, float, float]) -> Any:
    """The same with round things, each x, y and radius, standing before."""
    of_balls = [Ball(x, y, 0, 0, r).ranges(np.zeros(2), fan()) for x, y, r in balls]
    return np.fmin.reduce([ranges, *of_balls])


def crossing(times: Any, speed=1.2, x=3.0, start=-2.0, *, pillar: Any = None) -> tuple[Any, Any]:
    """Ranges (T, 181) of somebody on two legs who walks across, and which beams he is hit by."""
    behind = before(wall(), *([pillar] if pillar else []))
    scans = []
    for t in times:
        y, swing = start + speed * t, 0.15 * np.sin(2 * np.pi * t)
        scans.append(before(behind, (x - 0.1, y + swing, 0.07), (x + 0.1, y - swing, 0.07)))
    return np.array(scans), np.array(scans) < behind
