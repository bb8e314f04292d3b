"""In 3D a map that does not fit into memory is refused before the work."""

import numpy as np
import pytest

import stillmap
from stillmap.core import memory
from stillmap.pipeline.memory_need import require_map_memory

CELL = 0.15  # m


def sweeps(spread, count=20_000):
    """Two sweeps with returns up to `spread` m along each axis."""
    points = np.random.default_rng(0).uniform(-spread, spread, (2 * count, 3))
    return stillmap.Recording.from_clouds([0, 10**8], [points[:count], points[count:]])


def allow(monkeypatch, megabytes):
    monkeypatch.setattr(memory, "_allowed", megabytes * 10**6)


def test_returns_far_from_each_other_are_refused(monkeypatch):
    allow(monkeypatch, 50)
    with pytest.raises(stillmap.InputError, match=r"0\.15 m takes at least 0\.05\d* GB") as caught:
        stillmap.build(sweeps(500.0), {"threads": 1})
    assert "slam.voxel_size" in str(caught.value)


def test_as_many_close_to_each_other_are_not(monkeypatch):
    allow(monkeypatch, 50)
    require_map_memory(sweeps(3.0), None, CELL)


def test_more_memory_is_enough(monkeypatch):
    allow(monkeypatch, 60)
    require_map_memory(sweeps(500.0), None, CELL)


def test_the_way_of_the_robot_counts(monkeypatch):
    """The same sweep at many places shows as many surfaces."""
    points = np.random.default_rng(0).uniform(-20.0, 20.0, (2000, 3))
    T = 20
    recording = stillmap.Recording.from_clouds(np.arange(T) * 10**8, [points] * T)
    poses = np.tile(np.eye(4), (T, 1, 1))
    allow(monkeypatch, 50)
    require_map_memory(recording, poses, CELL)
    poses[:, 0, 3] = 100.0 * np.arange(T)
    with pytest.raises(stillmap.InputError, match="takes at least"):
        require_map_memory(recording, poses, CELL)


def test_of_long_recordings_some_beams_are_enough(monkeypatch):
    monkeypatch.setattr("stillmap.pipeline.memory_need._MAX_BEAMS", 20_000)
    allow(monkeypatch, 25)
    with pytest.raises(stillmap.InputError, match=r"at least 0\.02\d* GB"):
        require_map_memory(sweeps(500.0), None, CELL)


def test_the_printed_method_counts_what_beams_cross(monkeypatch):
    allow(monkeypatch, 100)
    require_map_memory(sweeps(20.0, 2000), None, CELL)
    with pytest.raises(stillmap.InputError, match="beams of up to 3") as caught:
        stillmap.build(sweeps(20.0, 2000), {"threads": 1, "estimator": "paper"})
    assert "slam.voxel_size" in str(caught.value)
    require_map_memory(sweeps(3.0, 2000), None, CELL, counts_beams=True)
