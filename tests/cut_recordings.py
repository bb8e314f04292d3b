"""A recording of a robot that drives through a made-up room, and its parts."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from stillmap.core import se2
from stillmap.core.recording import Recording
from stillmap.core.source import RangeRule, SensorNotes, Source
from stillmap.io import writers
from stillmap.prepare.options import ReadOptions
from stillmap.prepare.time_window import TimeWindow, select_time

START = 1_600_000_000  # s
PERIOD = 0.1  # s between scans
N = 16  # beams
ENDINGS = {"carmen": ".clf", "bag": ".bag", "db3": ".db3", "mcap": ".mcap"}  # of files, by format
CASES = [  # formats that hold recordings of each dimension
    *((2, form) for form in (*ENDINGS, "ros2", "stillmap")),
    *((3, form) for form in ("bag", "mcap", "kitti", "pcd", "stillmap")),
]
# noted, so that writers of parts state the angles and limits of the whole to the last digit
_LASER = SensorNotes(
    start_angle=-1.0,
    angle_step=2.0 / (N - 1),
    ranges=RangeRule(20.0, "", "unusable", None, 0.0),
)


def make_recording(
    dimension=2, scans=60, start=START, seed=3, odometry=True, speed=0.5
) -> Recording:
    """Scans 0.1 s apart of random ranges, on a curve at a constant speed (m/s)."""
    rng = np.random.default_rng(seed)
    stamp_ns = start * 10**9 + int(1e9 * PERIOD) * np.arange(scans, dtype=np.int64)
    at = PERIOD * np.arange(scans)
    flat = se2.exp(at[:, None] * np.array([speed, 0.0, 0.1]))
    T = np.tile(np.eye(dimension + 1), (scans, 1, 1))
    T[:, :2, :2], T[:, :2, -1] = flat[:, :2, :2], flat[:, :2, 2]
    angle, length = np.linspace(-1.0, 1.0, N), rng.uniform(1.0, 9.0, (scans, N)).round(2)
    points = np.stack([length * np.cos(angle), length * np.sin(angle), 0.1 * length], axis=-1)
    return Recording(
        stamp_ns=stamp_ns,
        offset=np.arange(scans + 1, dtype=np.int64) * N,
        points=points[..., :dimension].reshape(-1, dimension).astype(np.float32),
        hit=np.ones(scans * N, np.bool_),
        T_base_sensor=np.eye(dimension + 1)[None],
        sensor=np.zeros(scans, np.int32),
        T_odom_base=T if odometry else None,
        source=Source(sensors=[_LASER] if dimension == 2 else []),
    )


def cut(recording: Recording, first: float, last: float) -> Recording:
    """The scans from `first` to `last` seconds after the start, both included."""
    part = select_time(recording, TimeWindow(ReadOptions(start=first or None, end=last)))
    return replace(part, source=recording.source)


def write_whole(recording: Recording, folder: Path, form: str) -> Path:
    """Write a recording as a file or folder; returns its path."""
    path = folder / f"whole{ENDINGS.get(form, '')}"
    writers.write(recording, path, name=form)
    return path


def write_parts(recording: Recording, folder: Path, form: str, *spans) -> list[str]:
    """Write parts (first, last second) as files `part_K`; returns their paths."""
    out = []
    for number, (first, last) in enumerate(spans):
        path = folder / f"part_{number}{ENDINGS.get(form, '')}"
        writers.write(cut(recording, first, last), path, name=form)
        out.append(str(path))
    return out
