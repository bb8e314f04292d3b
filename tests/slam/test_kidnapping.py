"""Whether the scans ahead contradict the map, and where a segment of them lies."""

import dataclasses
import functools

import numpy as np
import pytest

from stillmap import _core
from stillmap.core import se2
from stillmap.sim import scene_by_name, simulate
from stillmap.slam import relocalization
from stillmap.slam.motion_model import gaussian_prior
from stillmap.slam.relocalization import Evidence, Placement
from stillmap.slam.scan_hits import add_scan, make_scan, select_hits
from stillmap.slam.scan_matching import accept_prior


@functools.cache
def office():
    options = {"robot": {"scans": 400}, "crowd": {"people": 4}, "odometry": {}}
    return simulate(scene_by_name("office", options), 3)


def mapped(scans):
    """Map of some scans at their true poses; labels; truth."""
    simulation = office()
    e = np.full(simulation.recording.n_beams, 0.9, np.float32)
    grid = _core.OccupancyGrid2D(0.05, 0.5)
    for t in scans:
        add_scan(grid, simulation.recording, e, t, simulation.truth.T_world_base[t])
    return grid, e, simulation.truth.T_world_base


def look_ahead(grid, e, T, t, pose):
    increments = se2.inverse(T[:-1]) @ T[1:]
    return relocalization.look_ahead(office().recording, e, grid, increments, t, pose, 0.9)


def test_scans_at_their_place_agree():
    grid, e, T = mapped(range(0, 200, 4))
    outlook = look_ahead(grid, e, T, 100, T[100])
    assert not outlook.contradicts
    assert 100 < outlook.last < 400


@pytest.mark.parametrize("turn", [0.7, 2.6, -1.5])
def test_scans_elsewhere_contradict(turn):
    grid, e, T = mapped(range(0, 200, 4))
    there = T[150] @ se2.matrix(0.0, 0.0, turn)
    assert look_ahead(grid, e, T, 20, there).contradicts


def test_the_end_of_the_recording_decides_nothing():
    grid, e, T = mapped(range(0, 200, 4))
    outlook = look_ahead(grid, e, T, 399, T[150] @ se2.matrix(0.0, 0.0, 1.0))
    assert not outlook.contradicts
    assert outlook.last == 399


def test_a_scan_of_an_unknown_place_says_nothing():
    grid, e, _ = mapped(range(0, 40, 4))
    far = se2.matrix(500.0, 0.0, 0.0)
    scan = select_hits(office().recording, e, 5)
    poor = dataclasses.replace(accept_prior(gaussian_prior(far, 0.1, 0.1)), explained=0.0)
    assert relocalization.judge_scan(grid, scan, poor, 1.0) is Evidence.UNKNOWN
    blind = make_scan(np.zeros((0, 2), np.float32), np.zeros(0, np.float32), np.eye(3))
    assert relocalization.judge_scan(grid, blind, poor, 1.0) is Evidence.UNKNOWN


@pytest.mark.parametrize(
    ("fitting", "contradicting", "tested", "supported", "contradicted"),
    [(3, 0, 9, True, False), (2, 0, 9, False, False), (8, 2, 15, True, False),
     (8, 3, 15, False, False), (0, 5, 15, False, True), (2, 8, 15, False, True),
     (3, 8, 15, False, False), (0, 4, 4, False, False), (0, 5, 16, False, False)],
)  # fmt: skip
def test_support_of_a_placement(fitting, contradicting, tested, supported, contradicted):
    placement = Placement(np.eye(3), fitting, contradicting, tested)
    assert placement.is_supported == supported
    assert placement.is_contradicted(0.33) == contradicted
    assert not placement.is_contradicted(1.0)


def test_one_of_many_places_has_to_be_much_better():
    here = Placement(np.eye(3), 4, 4, 60)
    for fitting, contradicting, is_better in ((18, 0, True), (17, 0, False), (30, 4, False)):
        there = Placement(np.eye(3), fitting, contradicting, 60)
        assert there.is_better(here) == is_better
    # few keyframes
    assert Placement(np.eye(3), 8, 0, 10).is_better(Placement(np.eye(3), 0, 6, 10))
    assert not Placement(np.eye(3), 7, 0, 10).is_better(Placement(np.eye(3), 0, 6, 10))


def test_time_to_carry_the_robot():
    assert not relocalization.is_gap(5.0, 0.1)
    assert relocalization.is_gap(5.1, 0.1)
    assert not relocalization.is_gap(15.0, 1.0)  # a sparse recording
