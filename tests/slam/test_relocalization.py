"""Kidnapped robots: detected and relocalized."""

import dataclasses

import numpy as np
import pytest
from driven import ate, mapped, picked
from marks import slow_params
from rooms import drive

from stillmap.core import se2
from stillmap.results.eval.trajectory import compute_absolute_errors
from stillmap.sim import scene_by_name, simulate


def carried(world, seed, beams, **robot):
    chosen = {"robot": robot, "crowd": {"people": 2}, "laser": {"beams": beams}}
    return simulate(scene_by_name(world, chosen), seed)


def assert_noticed_and_placed(simulation):
    found = mapped(simulation.recording)
    assert found.diagnostics.breaks == [simulation.truth.scene["carried_at_scan"]]
    assert found.diagnostics.ambiguous == []
    assert ate(found, simulation.truth) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, *slow_params(1)])
def test_kidnapped_robot_is_relocalized(seed):
    simulation = carried("office", seed, 90, scans=500, speed=1.5, carried_at=0.7)
    truth = simulation.truth
    before, at = np.array([-1, 0]) + truth.scene["carried_at_scan"]
    assert np.linalg.norm(truth.T_world_base[at] - truth.T_world_base[before]) > 20.0
    assert_noticed_and_placed(simulation)


OFFICE = {"scans": 1500, "carried_at": 0.6}
WAREHOUSE = {"scans": 900, "speed": 1.0, "carried_at": 0.6}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("world", "seed", "beams", "robot"),
    [
        *(("office", seed, 180, OFFICE) for seed in range(5)),
        *(("warehouse", seed, 120, WAREHOUSE) for seed in range(3)),
    ],
)
def test_relocalization_in_large_places(world, seed, beams, robot):
    assert_noticed_and_placed(carried(world, seed, beams, **robot))


@pytest.mark.slow
def test_a_slow_robot_with_many_scans_is_noticed():
    simulation = carried("office", 0, 90, scans=1500, speed=0.25, carried_at=0.6)
    assert mapped(simulation.recording).diagnostics.segments == [900]


@pytest.mark.slow
def test_relocalization_among_people():
    # they hide so much that nothing explains 85 % of a scan
    robot = {"scans": 2000, "carried_at": 0.5, "carried_by": 20.0}
    assert_noticed_and_placed(simulate(scene_by_name("hall", {"robot": robot}), 27))


def one_after_the_other(a, b):
    """One recording of both; odometry goes on as if nothing had happened."""
    T = a.T_odom_base[-1] @ se2.inverse(b.T_odom_base[0]) @ b.T_odom_base
    both = [(getattr(a, name), getattr(b, name)) for name in ("points", "hit", "sensor")]
    points, hit, sensor = (np.concatenate(pair) for pair in both)
    return dataclasses.replace(
        a,
        stamp_ns=np.concatenate([a.stamp_ns, b.stamp_ns + a.stamp_ns[-1] + 10**9 - b.stamp_ns[0]]),
        offset=np.concatenate([a.offset, b.offset[1:] + a.offset[-1]]),
        points=points,
        hit=hit,
        sensor=sensor,
        T_odom_base=np.concatenate([a.T_odom_base, T]),
    )


def test_return_to_the_same_room():
    # carried back to where it was, turned about: 5 m from where odometry goes on
    laser = {"beams": 120, "range_noise": 0.01, "max_range": 20.0}
    once = drive(2, laser=laser, robot={"scans": 60})
    found = mapped(one_after_the_other(once.recording, once.recording))
    assert found.diagnostics.breaks == [60]
    assert found.diagnostics.ambiguous == []
    truth = np.concatenate([once.truth.T_world_base] * 2)
    assert compute_absolute_errors(found.poses, truth).rmse < 0.02


def test_a_pause_is_no_proof_that_the_robot_was_carried():
    # a logger that stops for two minutes; odometry goes on from where it was
    once = drive(2, laser={"beams": 120, "range_noise": 0.01, "max_range": 20.0})
    stamp_ns = once.recording.stamp_ns.copy()
    stamp_ns[len(stamp_ns) // 2 :] += 120 * 10**9
    paused = mapped(dataclasses.replace(once.recording, stamp_ns=stamp_ns))
    assert paused.diagnostics.breaks == []
    assert ate(paused, once.truth) < 0.05
    # the scan after it is matched, not taken where odometry leads
    usual = mapped(once.recording)
    np.testing.assert_allclose(paused.explained, usual.explained, atol=0.05)


def test_a_scan_without_returns_after_a_pause_begins_no_segment():
    once = drive(2, laser={"beams": 120, "range_noise": 0.01, "max_range": 20.0})
    recording, first = once.recording, once.recording.n_scans // 2
    stamp_ns, hit = recording.stamp_ns.copy(), recording.hit.copy()
    stamp_ns[first:] += 120 * 10**9
    hit[recording.beams_of(first)] = False
    paused = mapped(dataclasses.replace(recording, stamp_ns=stamp_ns, hit=hit))
    assert paused.diagnostics.segments == []
    assert ate(paused, once.truth) < 0.05


@pytest.mark.parametrize("seed", [0, *slow_params(3)])
def test_a_gap_in_which_odometry_errs(seed):
    # 12 s are lost; after 3.4 m odometry is off by .42 m and .25 rad, within its covariance
    chosen = {"robot": {"scans": 900}, "crowd": {"people": 2}, "laser": {"beams": 120}}
    simulation = simulate(scene_by_name("office", chosen), seed)
    kept = np.r_[0:500, 560:900]
    T = simulation.recording.T_odom_base.copy()
    T[560:] = T[559] @ se2.matrix(0.3, 0.3, 0.25) @ se2.inverse(T[559]) @ T[560:]
    found = mapped(picked(dataclasses.replace(simulation.recording, T_odom_base=T), kept))
    assert found.diagnostics.breaks == []
    assert found.diagnostics.ambiguous == []
    truth = simulation.truth.T_world_base[kept]
    assert compute_absolute_errors(found.poses, truth).rmse < 0.05
