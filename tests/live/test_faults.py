"""What goes wrong on robots: nothing crashes, and nothing is silently wrong."""

from dataclasses import replace

import numpy as np
import pytest

from stillmap.core import se2
from stillmap.live.mapper import LiveMapper
from stillmap.live.replay import iter_beams
from stillmap.sim import scene_by_name, simulate

FAULT = range(150, 200)  # 10 s


@pytest.fixture(scope="module")
def answers(corridor):
    """Answers to the corridor's first 300 scans, with a fault in the midst."""

    def run(change):
        odometry, found = corridor.recording.T_odom_base, []
        with LiveMapper({"threads": 1}) as mapper:
            for k, beams in enumerate(iter_beams(corridor.recording)):
                if k == 300:
                    break
                given = beams, odometry[k]
                found.append(mapper.push(*(change(*given) if k in FAULT else given)))
        return found

    return run


def error(corridor, updates, scans):
    """m off, at most, relative to the first pose."""
    T = corridor.truth.T_world_base
    true = se2.inverse(T[0]) @ T[scans]
    poses = np.array([updates[k].pose for k in scans])
    return np.hypot(*(poses - true)[:, :2, 2].T).max()


def cover(beams):
    return replace(beams, points=np.full_like(beams.points, np.nan), hit=np.zeros_like(beams.hit))


def surround(beams):
    """A close obstacle everywhere."""
    length = np.linalg.norm(beams.points, axis=1, keepdims=True)
    return replace(beams, points=0.1 * beams.points / np.maximum(length, np.float32(1e-3)))


@pytest.mark.parametrize("change", [cover, surround])
def test_a_laser_that_is_covered(corridor, answers, change):
    updates = answers(lambda beams, T_odom_base: (change(beams), T_odom_base))
    assert all("blind" in updates[k].doubts for k in FAULT)
    assert all(np.isnan(updates[k].p_static).all() for k in FAULT)
    assert not any("blind" in updates[k].doubts for k in range(140))
    assert updates[199].covariance[0, 0] > updates[149].covariance[0, 0]
    off = np.array([error(corridor, updates, range(k, k + 1)) for k in FAULT])
    std = np.sqrt([updates[k].covariance[0, 0] for k in FAULT])
    assert (off < 3.0 * std + 0.05).all()
    assert error(corridor, updates, range(210, 300)) < 0.2


def test_odometry_that_is_lost(corridor, answers):
    updates = answers(lambda beams, _: (beams, None))
    assert all(updates[k].T_map_odom is None for k in FAULT)
    assert updates[200].T_map_odom is not None
    assert error(corridor, updates, range(300)) < 0.15


def test_odometry_that_stands_still(corridor, answers):
    T = corridor.recording.T_odom_base[149]
    updates = answers(lambda beams, _: (beams, T))
    assert any("slip" in updates[k].doubts for k in FAULT)
    assert error(corridor, updates, range(300)) < 0.3


def test_odometry_that_stands_still_under_a_fast_laser():
    changes = {"robot": {"scans": 600, "scan_rate": 20.0}}
    simulation = simulate(scene_by_name("corridor", changes), 8)
    odometry, updates = simulation.recording.T_odom_base.copy(), []
    odometry[300:500] = odometry[299]
    with LiveMapper({"threads": 1}) as mapper:
        for beams, T_odom_base in zip(iter_beams(simulation.recording), odometry, strict=True):
            updates.append(mapper.push(beams, T_odom_base))
    slips = np.array(["slip" in update.doubts for update in updates])
    assert slips[300:500].mean() > 0.6  # the robot stands, too
    assert not slips[:300].any()
    assert not slips[515:].any()
    assert error(simulation, updates, range(600)) < 0.1


def test_odometry_that_jumps(corridor, answers):
    rng = np.random.default_rng(0)

    def jump(beams, T_odom_base):
        return beams, se2.matrix(*rng.normal(size=3) * (3.0, 3.0, 1.0)) @ T_odom_base

    updates = answers(jump)
    assert error(corridor, updates, range(300)) < 0.15


def test_a_clock_that_leaps_by_decades(corridor):
    """As where it was not set before the network was there."""
    leap_ns = 40 * 365 * 86_400 * 10**9
    updates = []
    with LiveMapper({"threads": 1}) as mapper:
        for k, beams in enumerate(corridor.beams[:150]):
            later = replace(
                beams, stamp_ns=beams.stamp_ns + (k >= 50) * leap_ns + (k >= 100) * leap_ns
            )
            updates.append(mapper.push(later, corridor.recording.T_odom_base[k]))
    assert error(corridor, updates, range(150)) < 0.15
    for k in (60, 140):
        hit, static = corridor.beams[k].hit, corridor.truth.static[corridor.recording.beams_of(k)]
        assert np.mean((updates[k].p_static > 0.5) == static, where=hit) > 0.9
