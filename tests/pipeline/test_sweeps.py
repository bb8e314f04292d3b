"""From the third iteration on poses are swept: where they come from, and what is still told."""

import dataclasses

import numpy as np
import pytest

import stillmap
from stillmap import slam
from stillmap.core import se2
from stillmap.core.config import override
from stillmap.pipeline.options import Options

# so short a way that there is something to close after a metre, and wheels that are believed
ERRORS = (f"{a}_per_{b}" for a in ("translation", "rotation") for b in ("metre", "radian"))
SLAM = {"keyframe_distance": 0.3, "odometry": dict.fromkeys(ERRORS, 0.0)}
EM = {"max_iterations": 4, "held_out": 0}
CHOSEN = override(Options(), {"threads": 1, "em": EM, "slam": SLAM})


@pytest.fixture(autouse=True)
def short_loops(monkeypatch):
    monkeypatch.setattr("stillmap.slam.loop_candidates.MIN_LOOP_TRAVEL", 1.0)


@pytest.fixture
def leaping(room):
    """The wheels of scan 30 turned about."""
    T = room.recording.T_odom_base.copy()
    increment = se2.inverse(T[29]) @ T[30]
    T[30:] = T[29] @ se2.matrix(0.0, 0.0, 3.0) @ increment @ se2.inverse(T[30]) @ T[30:]
    return dataclasses.replace(room.recording, T_odom_base=T)


def test_from_the_third_on_poses_are_those_of_the_one_before_swept(leaping):
    before = None
    for it in stillmap.iterate(leaping, CHOSEN):
        earlier = None if before is None else before.estimate.m_step
        start = earlier if it.estimate.number > 2 else None
        given = leaping, it.estimate.weights, CHOSEN.slam, None, 1, lambda *_: None
        mapped = slam.m_step(*given, initial=start, earlier=earlier)
        np.testing.assert_array_equal(it.estimate.poses, mapped.poses)
        np.testing.assert_array_equal(it.estimate.m_step.covariance, mapped.covariance)
        before = it


def test_what_was_hard_to_place_is_still_told_after_a_sweep(leaping):
    found = [it.estimate for it in stillmap.iterate(leaping, CHOSEN)]
    assert len(found) == 4
    assert 30 in found[1].m_step.diagnostics.widened
    assert found[1].m_step.loops
    for it in found[2:]:
        assert it.m_step.diagnostics.widened == found[1].m_step.diagnostics.widened
        assert it.m_step.loops == found[1].m_step.loops
        np.testing.assert_array_equal(it.m_step.explained, found[1].m_step.explained)
