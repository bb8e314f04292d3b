"""Boxes that pass a lidar that stands still before a wall, followed as told."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from recordings import of_one_sensor

from stillmap.core.recording import Recording
from stillmap.mesh.inputs import MeshInputs, TrackedBox
from stillmap.mesh.reconstruction import ObjectShape, reconstruct_object
from stillmap.mesh.returns import DynamicReturns, collect_tracks, merge_tracks
from stillmap.tracking import MovingObject
from stillmap.tracking.boxes import fit_box

Float = NDArray[np.float64]

WALL = 30.0  # m
RATE = 10.0  # Hz


class Car(NamedTuple):
    """A box on the ground: where its middle is at 0 s, how fast it is, and its size."""

    start: tuple[float, float]
    velocity: tuple[float, float]
    size: tuple[float, float, float] = (4.0, 1.8, 1.5)


class Part(NamedTuple):
    """What is followed as one object: the beams on a car between two shares of its length.

    `drift` (2,) m/s is by how much its track is wrong.
    """

    car: int
    first: float = 0.0
    last: float = 1.0
    scans: tuple[int, int] = (0, 1000)
    drift: tuple[float, float] = (0.0, 0.0)


def street(
    cars: list[Car], parts: list[Part], scans: int = 8, noise: float = 0.0, rows: int = 21
) -> MeshInputs:
    """Everything that is known of such a recording; the sensor is 1 m above the ground."""
    rng = np.random.default_rng(0)
    turn, rise = np.radians(np.arange(-60.0, 60.0, 0.5)), np.radians(np.linspace(-12.0, 6.0, rows))
    turn, rise = (a.ravel() for a in np.meshgrid(turn, rise, indexing="ij"))
    looking = np.stack([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)], 1)
    n, ends, whose = len(looking), [], []
    for scan in range(scans):
        ranges, met = WALL / looking[:, 0], np.full(n, -1)
        for k, car in enumerate(cars):
            middle = np.array([*car.start, 0.5 * car.size[2] - 1.0])
            middle[:2] += np.array(car.velocity) * scan / RATE
            near = _to_box(looking, middle, 0.5 * np.array(car.size))
            met, ranges = np.where(near < ranges, k, met), np.minimum(near, ranges)
        ranges = ranges + rng.normal(0.0, noise, n) * (met >= 0)
        ends.append(looking * ranges[:, None])
        whose.append(met)
    recording = of_one_sensor(
        (10**9 * np.arange(scans) / RATE).astype(np.int64),
        n * np.arange(scans + 1, dtype=np.int64),
        np.concatenate(ends).astype(np.float32),
        np.ones(n * scans, np.bool_),
    )
    poses = np.tile(np.eye(4), (scans, 1, 1))
    poses[:, 2, 3] = 1.0
    met = np.concatenate(whose)
    objects = [_object(k, part, cars, recording, poses, met) for k, part in enumerate(parts)]
    things = [
        TrackedBox(fit_box(one, 0), one.z - 0.5 * one.size[2], one.size[2]) for one in objects
    ]
    p_static = np.where(met >= 0, 0.05, 0.95).astype(np.float32)
    return MeshInputs(recording, recording, poses, p_static, objects, things, 0)


def _to_box(looking: Float, middle: Float, half: Float) -> Float:
    """(n,) metres from the origin to a box, infinite where a beam misses it."""
    with np.errstate(divide="ignore"):
        one, other = (middle - half) / looking, (middle + half) / looking
    enters, leaves = np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)
    return np.where((enters <= leaves) & (enters > 0.0), enters, np.inf)


def _object(
    id: int, part: Part, cars: list[Car], recording: Recording, poses: Float, met: NDArray[np.intp]
) -> MovingObject:
    car = cars[part.car]
    beams = np.flatnonzero(met == part.car)
    scan = recording.scans_of(beams)
    ends = recording.end_points(beams, poses)
    along = ends[:, 0] - car.start[0] - car.velocity[0] * scan / RATE + 0.5 * car.size[0]
    share = along / car.size[0]
    mine = (share >= part.first - 1e-6) & (share <= part.last + 1e-6)
    mine &= (scan >= part.scans[0]) & (scan < part.scans[1])
    scans = np.unique(scan[mine])
    seconds = scans / RATE
    middle = np.array(car.start)
    middle[0] += car.size[0] * (0.5 * (part.first + part.last) - 0.5)
    velocity = np.array(car.velocity) + part.drift
    xy = middle + seconds[:, None] * velocity
    size = (car.size[0] * (part.last - part.first), car.size[1], car.size[2])
    height = np.full(len(scans), 0.5 * car.size[2])
    v = np.tile(velocity, (len(scans), 1))
    return MovingObject(
        id, scans, recording.stamp_ns[scans], xy, v, size, beams[mine], 0.95, height
    )


def reconstruct_one(sources: MeshInputs) -> ObjectShape:
    """The shape of the one thing that all tracks are of."""
    moves = DynamicReturns.collect(sources)
    followed = collect_tracks(moves)
    (whole,) = merge_tracks(followed, moves)
    shape = reconstruct_object(whole, moves, [np.zeros(0)] * len(whole))
    assert shape is not None
    return shape
