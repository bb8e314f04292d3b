"""Scans of a half circle made up beam by beam, and walkers before a wall."""

import numpy as np

from stillmap.core.recording import Recording

ANGLES = np.radians(np.arange(-90.0, 91.0))
WALL = 6.0  # metres ahead


def recording(ranges, seconds=None, sensor=None):
    """Scans of 181 beams from the origin; inf: nothing came back, nan: unusable."""
    ranges = np.atleast_2d(np.asarray(ranges, float))
    T, N = ranges.shape
    seconds = 0.2 * np.arange(T) if seconds is None else np.asarray(seconds)
    u = np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])[:N]
    hit = np.isfinite(ranges)
    points = np.where(np.isinf(ranges), 20.0, ranges)[..., None] * u
    sensor = np.zeros(T) if sensor is None else np.asarray(sensor)
    return Recording(
        stamp_ns=np.round(1e9 * seconds).astype(np.int64),
        offset=N * np.arange(T + 1),
        points=points.reshape(-1, 2).astype(np.float32),
        hit=hit.ravel(),
        T_base_sensor=np.tile(np.eye(3), (1 + int(sensor.max(initial=0)), 1, 1)),
        sensor=sensor.astype(np.int32),
        T_odom_base=None,
    )


def poses(recording):
    return np.tile(np.eye(3), (recording.n_scans, 1, 1))


def wall():
    """(181,) metres to a wall across the way ahead, 10 m where it is farther than that."""
    with np.errstate(divide="ignore"):
        return np.minimum(WALL / np.maximum(np.cos(ANGLES), 1e-9), 10.0)


def before(ranges, *round_things):
    """The same with round things, each x, y and radius, standing before."""
    out = np.array(ranges, float)
    for x, y, radius in round_things:
        along = x * np.cos(ANGLES) + y * np.sin(ANGLES)
        depth = radius**2 - (x**2 + y**2 - along**2)
        near = along - np.sqrt(np.maximum(depth, 0.0))
        seen = (depth > 0) & (along > 0)
        out = np.where(seen, np.fmin(out, near), out)
    return out


def crossing(times, speed=1.2, x=3.0, start=-2.0, *, pillar=None):
    """Ranges (T, 181) of somebody on two legs who walks across, and which beams he is hit by."""
    scans, on = [], []
    for t in times:
        y = start + speed * t
        swing = 0.15 * np.sin(2 * np.pi * t)
        legs = ((x - 0.1, y + swing, 0.07), (x + 0.1, y - swing, 0.07))
        behind = before(wall(), *([pillar] if pillar else []))
        scans.append(before(behind, *legs))
        on.append(scans[-1] < behind)
    return np.array(scans), np.array(on)
