"""A robot that is carried while it maps: held back, searched in its own map, and found again."""

from dataclasses import replace

import numpy as np
import pytest

from stillmap.core import se2
from stillmap.live.mapper import LiveMapper
from stillmap.live.replay import iter_beams
from stillmap.results.eval.trajectory import align
from stillmap.sim import scene_by_name, simulate

BEFORE, AFTER = 300, 60


@pytest.fixture(scope="module")
def answers():
    """Updates, poses in hindsight and true poses: after 300 scans the robot is put back to where it
    was 200 scans before."""
    changes = {"crowd": {"people": 5}, "robot": {"scans": BEFORE}}
    simulation = simulate(scene_by_name("hall", changes), 1)
    odometry, beams = simulation.recording.T_odom_base, list(iter_beams(simulation.recording))
    scans = np.append(np.arange(BEFORE), np.arange(100, 100 + AFTER))
    given, updates = odometry[0], []
    with LiveMapper({"threads": 1}) as mapper:
        for number, k in enumerate(scans):
            if number not in (0, BEFORE):
                given = given @ se2.inverse(odometry[k - 1]) @ odometry[k]
            beams_now = replace(beams[k], stamp_ns=200_000_000 * number)
            updates.append(mapper.push(beams_now, given))
        poses = mapper.poses
    return updates, poses, simulation.truth.T_world_base[scans]


def errors(poses, true):
    """m off, in the frame of the scans before."""
    T = align(true[: BEFORE - 5], poses[: BEFORE - 5])
    return np.hypot(*(T @ true - poses)[:, :2, 2].T)


def test_it_is_found_in_its_own_map(answers):
    updates, poses, true = answers
    doubts = [update.doubts for update in updates]
    off = errors(np.array([update.pose for update in updates]), true)
    assert off[BEFORE] > 5.0
    assert all(one for one, far in zip(doubts, off, strict=True) if far > 0.3)
    assert not any("contradicted" in one for one in doubts[:BEFORE])
    carried = next(k for k in range(BEFORE, len(doubts)) if "carried" in doubts[k])
    assert any("lost" in one for one in doubts[carried + 1 :])
    assert not doubts[-1]
    assert off[-10:].max() < 0.1
    # in hindsight
    off = errors(poses, true)
    assert off[: BEFORE - 5].max() < 0.1  # the last ones may have fit by chance
    assert np.isnan(off[BEFORE:carried]).all()  # they fit neither here nor there
    assert off[carried:].max() < 0.1
