"""Two sessions of a simulated hall, and what is merged from them."""

from pathlib import Path

import numpy as np
import pytest

from stillmap.cli.main import main
from stillmap.core import se2
from stillmap.core.recording import Recording


@pytest.fixture(scope="session")
def days(tmp_path_factory) -> Path:
    """A folder with three short sessions of an office, mapped: out-1, out-2, out-3."""
    folder = tmp_path_factory.mktemp("days")
    words = ["simulate", "hall", "-o", str(folder / "sim"), "--sessions", "3", "--scans", "260"]
    assert main([*words, "--seed", "5", "--quiet"]) == 0
    for k in (1, 2, 3):
        session = folder / "sim" / f"session-{k}"
        words = ["map", str(session), "-o", str(folder / f"out-{k}"), "--quiet", "--threads", "1"]
        assert main(words) == 0
    return folder


@pytest.fixture(scope="session")
def place(days) -> Path:
    """The place of all three."""
    results = [str(days / f"out-{k}") for k in (1, 2, 3)]
    assert main(["merge", *results, "-o", str(days / "place"), "--quiet", "--threads", "1"]) == 0
    return days / "place"


def scan_room(x0, y0, x1, y1, poses, n_beams=180):
    """A recording of an empty room of four walls, seen all round from poses (T, 3, 3)."""
    angles = np.linspace(-np.pi, np.pi, n_beams, endpoint=False)
    points = []
    for x, y, theta in se2.parameters(poses):
        c, s = np.cos(angles + theta), np.sin(angles + theta)
        with np.errstate(divide="ignore"):
            reach = np.minimum(
                np.where(c > 0, (x1 - x) / c, (x0 - x) / c),
                np.where(s > 0, (y1 - y) / s, (y0 - y) / s),
            )
        points.append(np.stack([np.cos(angles), np.sin(angles)], axis=1) * reach[:, None])
    T, M = len(poses), len(poses) * n_beams
    return Recording(
        stamp_ns=np.arange(T) * 100_000_000,
        offset=np.arange(T + 1) * n_beams,
        points=np.concatenate(points).astype(np.float32),
        hit=np.ones(M, np.bool_),
        T_base_sensor=np.eye(3)[None],
        sensor=np.zeros(T, np.int32),
        T_odom_base=None,
    )
