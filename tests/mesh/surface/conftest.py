"""Recordings of simple rooms, ray-traced."""

from types import SimpleNamespace

import numpy as np
import pytest
from recordings import of_one_sensor

ROOM = np.array([[-3.0, -2.0, -1.2], [5.0, 3.0, 1.6]])  # its lowest and its highest corner


def ranges(origin, direction, box=None):
    """(n,) metres from within the room to its walls, or to a box in it."""
    with np.errstate(divide="ignore"):
        far = np.where(direction > 0, ROOM[1] - origin, ROOM[0] - origin) / direction
    out = np.where(direction == 0, np.inf, far).min(axis=1)
    if box is not None:
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = (np.asarray(box)[:, None] - origin) / direction
        enter, leave = ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)
        out = np.where((enter < leave) & (enter > 0), np.minimum(out, enter), out)
    return out


def scans(looking, poses, noise=0.0, box=None, seed=0, step_ns=10**8):
    """A recording of directions (n, 3), or (T, n, 3), from poses (T, 4, 4)."""
    rng, T = np.random.default_rng(seed), len(poses)
    looking = np.broadcast_to(looking, (T, *np.shape(looking)[-2:]))
    points = []
    for d, pose in zip(looking, poses, strict=True):
        r = ranges(pose[:3, 3], d @ pose[:3, :3].T, box)
        points.append((r + noise * rng.standard_normal(len(r)))[:, None] * d)
    return of_one_sensor(
        np.arange(T, dtype=np.int64) * step_ns,
        np.arange(T + 1, dtype=np.int64) * looking.shape[1],
        np.concatenate(points).astype(np.float32),
        np.ones(T * looking.shape[1], np.bool_),
    )


def towards(azimuth, elevation):
    """Directions of length one."""
    azimuth, elevation = np.broadcast_arrays(azimuth, elevation)
    c = np.cos(elevation)
    return np.stack([c * np.cos(azimuth), c * np.sin(azimuth), np.sin(elevation)], axis=-1)


def lidar(columns=240, channels=24, rows_are="columns"):
    """(n, 3) directions of a turn; rows are columns, as lidars send them, or rings."""
    azimuth = np.arange(columns) * (2 * np.pi / columns)
    elevation = np.linspace(-0.5, 0.5, channels)
    grid = towards(azimuth[:, None], elevation[None])
    return (grid if rows_are == "columns" else grid.swapaxes(0, 1)).reshape(-1, 3)


def picture(width=64, height=48, focal=50.0):
    """(n, 3) directions of a depth picture that looks along x."""
    u, v = np.meshgrid(np.arange(width) - width / 2, np.arange(height) - height / 2)
    d = np.stack([np.full(u.shape, focal), -u, -v], axis=-1).reshape(-1, 3)
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def nods(T=60, amplitude=0.6, period=40):
    """(T, 3, 3) how a laser is turned that nods evenly."""
    share = (np.arange(T) / period + 0.25) % 1.0
    tilt = amplitude * (1.0 - 4.0 * np.abs(share - 0.5))
    c, s, o, i = np.cos(tilt), np.sin(tilt), np.zeros(T), np.ones(T)
    return np.stack([c, o, s, o, i, o, -s, o, c], axis=-1).reshape(T, 3, 3)


def nodding(T=60, beams=61):
    """(T, n, 3) directions of a planar laser that nods."""
    fan = towards(np.linspace(-1.4, 1.4, beams), np.zeros(beams))
    return np.einsum("tij,nj->tni", nods(T), fan)


def standing(T=1, *places):
    """(T, 4, 4) poses, at the origin or at places."""
    poses = np.tile(np.eye(4), (max(T, len(places)), 1, 1))
    if places:
        poses[:, :3, 3] = places
    return poses


def off_walls(points):
    """(n,) metres from the nearest wall of the room."""
    return np.abs(points[:, None] - ROOM).min(axis=(1, 2))


@pytest.fixture(scope="session")
def room():
    """What makes recordings."""
    parts = (lidar, nodding, nods, off_walls, picture, scans, standing, towards)
    return SimpleNamespace(**{one.__name__: one for one in parts}, corners=ROOM)
