"""Simulated sweeps of a spinning lidar among boxes, with truth."""

from dataclasses import dataclass

import numpy as np
from recordings import of_one_sensor

from stillmap.core import se2, se3
from stillmap.core.array_types import Bool, Float, Float32, Index
from stillmap.core.recording import Recording


@dataclass(frozen=True, eq=False)
class Boxes:
    """Boxes along the axes.

    Attributes:
        low, high: (B, 3) corners at time 0, metres.
        velocity: (B, 3) m/s; zero for what stands.
    """

    low: Float
    high: Float
    velocity: Float

    @classmethod
    def of(cls, rows: list[list[float]]) -> "Boxes":
        """Of rows centre x, y, z, size x, y, z, velocity x, y, z."""
        a = np.array(rows, np.float64)
        return cls(a[:, :3] - a[:, 3:6] / 2, a[:, :3] + a[:, 3:6] / 2, a[:, 6:9])


@dataclass(frozen=True)
class Lidar:
    """Rings that turn once per sweep, from behind and back; its stamp is half way round."""

    rings: int = 16
    columns: int = 360
    lowest: float = np.radians(-15.0)
    highest: float = np.radians(15.0)
    period: float = 0.1
    reach: float = 80.0
    noise: float = 0.02


def sweep(
    boxes: Boxes, lidar: Lidar, way: "Way", t: float, rng: np.random.Generator
) -> tuple[Float, Bool, Float, Bool]:
    """End points (N, 3) in the frame of the lidar as it moves, hits, times, and hits on movers."""
    azimuth, rise = np.meshgrid(
        np.linspace(-np.pi, np.pi, lidar.columns, endpoint=False),
        np.linspace(lidar.lowest, lidar.highest, lidar.rings),
        indexing="ij",
    )
    azimuth, rise = azimuth.ravel(), rise.ravel()
    tau = lidar.period * azimuth / (2.0 * np.pi)
    c = np.cos(rise)
    direction = np.stack([c * np.cos(azimuth), c * np.sin(azimuth), np.sin(rise)], axis=-1)
    column = np.arange(len(tau)) // lidar.rings
    T = way.at(t + tau[:: lidar.rings])[column]
    beams = np.einsum("nij,nj->ni", T[:, :3, :3], direction)
    distance, hit_box = _cast(boxes, T[:, :3, 3], beams, t + tau)
    hit = distance < lidar.reach
    distance = np.where(hit, distance + rng.normal(0.0, lidar.noise, len(tau)), lidar.reach)
    moving = hit & (np.abs(boxes.velocity[hit_box]).sum(axis=1) > 0.0)
    return direction * distance[:, None], hit, tau, moving


def _cast(boxes: Boxes, origin: Float, beams: Float, times: Float) -> tuple[Float, Index]:
    """Distances (N,) to the nearest faces, inf where there are none, and whose they are."""
    nearest, which = np.full(len(beams), np.inf), np.zeros(len(beams), np.intp)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / np.where(np.abs(beams) < 1e-12, 1e-12, beams)
        for b, (low, high, v) in enumerate(zip(boxes.low, boxes.high, boxes.velocity, strict=True)):
            at = origin - v * times[:, None] if v.any() else origin
            one, other = (low - at) * inverse, (high - at) * inverse
            enter = np.minimum(one, other).max(axis=1)
            leave = np.maximum(one, other).min(axis=1)
            # from within a box, as in a room, its walls are seen from behind
            d = np.where(enter > 1e-3, enter, leave)
            ok = (leave >= enter) & (d > 1e-3) & (d < nearest)
            nearest[ok], which[ok] = d[ok], b
    return nearest, which


@dataclass(frozen=True, eq=False)
class Way:
    """Knots of a smooth way.

    Attributes:
        T0: (4, 4) the pose at time 0.
        twists: (K, 6) velocity and rate of turn in the moving frame, from knot to knot.
        step: seconds between knots.
    """

    T0: Float
    twists: Float
    step: float

    def at(self, times: Float) -> Float:
        """(N, 4, 4) poses at times (N,)."""
        starts = [self.T0]
        for twist in self.twists:
            starts.append(starts[-1] @ se3.exp(self.step * twist))
        k = np.clip((times // self.step).astype(int), 0, len(self.twists) - 1)
        return np.array(starts)[k] @ se3.exp((times - k * self.step)[:, None] * self.twists[k])


def recorded(
    boxes: Boxes, lidar: Lidar, way: Way, sweeps: int, seed: int, begin: float = 1.0
) -> tuple[Recording, Float, Float32]:
    """A recording, the true poses (T, 4, 4) at its stamps, and e of the truth."""
    rng = np.random.default_rng(seed)
    stamps = begin + lidar.period * np.arange(sweeps)
    parts = [sweep(boxes, lidar, way, t, rng) for t in stamps]
    points, hit, tau, moving = (np.concatenate(p) for p in zip(*parts, strict=True))
    recording = of_one_sensor(
        np.round(stamps * 1e9).astype(np.int64),
        np.cumsum([0] + [len(p[1]) for p in parts]).astype(np.int64),
        points.astype(np.float32),
        hit,
        beam_time=tau.astype(np.float32),
    )
    truth = way.at(stamps)
    return recording, se2.inverse(truth[0]) @ truth, np.where(moving, 0.0, 1.0).astype(np.float32)
