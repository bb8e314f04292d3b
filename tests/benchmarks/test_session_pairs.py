"""Pairs of sessions overlap as wanted."""

import pytest
from session_pairs import OVERLAPS, measure_overlap, plan_pair, plan_wings

from stillmap.sim import scene_by_name
from stillmap.sim.sessions import compute_overlap, observe, simulate_sessions


@pytest.mark.slow
def test_wings_share_a_door_only() -> None:
    changes = {"laser": {"beams": 90}, "robot": {"scans": 150}, "crowd": {"people": 3}}
    sights = [observe(session) for session in simulate_sessions(plan_wings(1, changes))]
    assert compute_overlap(sights, [0, 0])[0, 1] < 0.1
    assert compute_overlap(sights, [0, 0])[0, 0] > 0.98


@pytest.mark.slow
@pytest.mark.parametrize("overlap", OVERLAPS, ids=lambda overlap: overlap.name)
def test_pairs_overlap_as_wanted(overlap) -> None:
    plan = plan_pair(scene_by_name("office"), overlap, 3)
    assert overlap.low <= measure_overlap(plan, with_people=True) < overlap.high
