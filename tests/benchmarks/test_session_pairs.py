"""Pairs of sessions overlap as wanted."""

import pytest
from session_overlap import compute_overlap, observe
from session_pairs import OVERLAPS, measure_overlap, plan_pair, plan_wings, stay_within

from stillmap.sim import scene_by_name
from stillmap.sim.sessions import plan_sessions, simulate_sessions

QUICK = {"laser": {"beams": 90}, "robot": {"scans": 150}, "crowd": {"people": 3}}


@pytest.mark.slow
def test_wings_share_a_door_only():
    made = [*simulate_sessions(plan_wings(1, QUICK))]
    sights = [observe(session.recording, session.truth) for session in made]
    assert compute_overlap(sights, [0, 0])[0, 1] < 0.1
    assert compute_overlap(sights, [0, 0])[0, 0] > 0.98


@pytest.mark.slow
@pytest.mark.parametrize("overlap", OVERLAPS, ids=lambda overlap: overlap.name)
def test_pairs_overlap_as_wanted(overlap):
    plan = plan_pair(scene_by_name("office"), overlap, 3)
    assert overlap.low <= measure_overlap(plan, with_people=True) < overlap.high


def test_robots_stay_in_their_regions():
    regions = ((0.0, 0.0, 18.0, 25.0), (22.0, 0.0, 40.0, 25.0))
    routes = [stay_within(region) for region in regions]
    plan = plan_sessions(scene_by_name("office", QUICK), 2, 4, routes=routes)
    for region, made in zip(regions, simulate_sessions(plan), strict=True):
        x = made.truth.T_world_base[:, 0, 2]
        assert x.min() > region[0]
        assert x.max() < region[2]
