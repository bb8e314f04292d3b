"""Quality of a place: it falls where sessions lie beside each other."""

from types import SimpleNamespace

import numpy as np
import pytest

from stillmap.pipeline.quality import rate_geometry
from stillmap.places.keyframes import join_keyframes, select_keyframes
from stillmap.sim import scene_by_name, simulate

SCANS = 200


@pytest.fixture(scope="module")
def rate():
    """Rates a place of one drive cut in two, the second part moved by some metres."""
    run = simulate(scene_by_name("office", {"robot": {"scans": SCANS, "scan_rate": 1.0}}), 0)
    nodes = np.arange(0, SCANS, 10)
    p_static = run.truth.static.astype(np.float32)
    keyframes = select_keyframes(run.recording, run.truth.T_world_base, p_static, nodes)
    p_occupied = np.zeros((200, 200), np.float32)
    p_occupied[:, 0] = 1.0

    def rate(apart=0.0, p_occupied=p_occupied):
        moved = keyframes.poses.copy()
        moved[:, :2, 2] += apart
        joined = join_keyframes([keyframes, keyframes]).recording
        occupancy = SimpleNamespace(p_occupied=p_occupied, resolution=0.05)
        return rate_geometry(joined, np.concatenate([keyframes.poses, moved]), occupancy)

    return rate


@pytest.mark.slow
def test_sessions_that_lie_apart_lower_geometry(rate):
    figures = [rate(apart) for apart in (0.0, 0.03, 0.1)]
    assert figures[0].geometry > figures[1].geometry + 5.0 > figures[2].geometry + 10.0
    assert figures[0].evidence.displacement < 0.01 < figures[1].evidence.displacement < 0.05


def test_labels_are_not_rated(rate):
    quality = rate()
    assert quality.labels is None
    assert quality.overall == quality.geometry


def test_small_pieces_lower_geometry(rate):
    scattered = np.zeros((200, 200), np.float32)
    scattered[::20, ::20] = 1.0
    assert rate(p_occupied=scattered).geometry < rate().geometry - 5.0


def test_nothing_can_be_told_of_an_empty_map(rate):
    assert rate(p_occupied=np.full((20, 20), np.nan, np.float32)).geometry is None
