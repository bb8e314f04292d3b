"""Steps of scan matching that are replaced by others with more evidence."""

import dataclasses
import importlib

import numpy as np
import pytest
from driven import ate, chained, picked, prior, silent
from rooms import drive
from scipy.special import betaln

import stillmap
from stillmap import _core, em, slam
from stillmap.core import se2
from stillmap.sim import scene_by_name, simulate
from stillmap.slam import odometry_2d, step_alternatives
from stillmap.slam.options import SlamOptions

M_STEP = importlib.import_module("stillmap.slam.m_step")  # the package has a function of that name


def room(scans=80):
    laser = {"range_noise": 0.01, "max_range": 8.0}
    return drive(2, people=1, laser=laser, robot={"scans": scans})


def test_log_evidence_is_that_of_beta_distributions():
    simulation = room(10)
    grid = _core.OccupancyGrid2D(0.05)
    assert grid.log_evidence(0.1, 0.5) == 0.0
    em.add_recording(grid, simulation.recording, simulation.truth.T_world_base, None)
    _, alpha, beta = grid.dense()
    for a, b in ((0.1, 0.5), (2.0, 1.0)):
        wanted = (betaln(alpha + a, beta + b) - betaln(a, b))[alpha > 0.0].sum()
        assert grid.log_evidence(a, b) == pytest.approx(wanted, rel=1e-9)
    for a, b in ((0.0, 1.0), (1.0, -1.0), (np.nan, 1.0)):
        with pytest.raises(ValueError, match="pseudo-counts"):
            grid.log_evidence(a, b)


def with_drift(recording):
    """Odometry that leads astray, but not from one scan to the next."""
    steps = se2.increments(recording.T_odom_base) @ se2.matrix(0.0, 0.0, np.radians(0.5))
    return dataclasses.replace(recording, T_odom_base=chained(steps))


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.5 * np.pi), (0.0, 0.0, np.pi), (1.0, 0.0, 0.0)])
def test_a_wrong_step_is_replaced(monkeypatch, offset):
    simulation, calls = room(), []

    def err(recording, *args, **options):
        matched = odometry_2d.register_scans(recording, *args, **options)
        calls.append(recording.n_scans)
        if len(calls) > 1:
            return matched
        poses, wrong = matched.poses.copy(), se2.matrix(*offset)
        poses[40:] = poses[40] @ wrong @ se2.inverse(poses[40]) @ poses[40:]
        diagnostics = dataclasses.replace(matched.diagnostics, widened=[40])
        return dataclasses.replace(matched, poses=poses, diagnostics=diagnostics)

    monkeypatch.setattr(M_STEP, "register_scans", err)
    recording = with_drift(simulation.recording)
    options = slam.SlamOptions()
    found = slam.m_step(recording, prior(recording), options, None, 1, lambda *_: None)
    assert ate(found, simulation.truth) < 0.02
    assert found.diagnostics.widened == []
    assert len(calls) > 1


def test_steps_in_no_trouble_are_not_matched_again(monkeypatch):
    recording = room().recording
    calls = []

    def count(*args, **options):
        calls.append(args)
        return odometry_2d.register_scans(*args, **options)

    monkeypatch.setattr(M_STEP, "register_scans", count)
    e = prior(recording)
    found = slam.m_step(recording, e, slam.SlamOptions(), None, 1, lambda *_: None)
    assert len(calls) == 1
    assert found.diagnostics.odometry_faults == []


def test_windows_and_differences():
    travelled = np.arange(0.0, 100.0)
    windows = step_alternatives._windows(travelled, np.array([0, 40, 45, 99]))
    assert windows == [(0, 10), (30, 55), (89, 100)]
    assert step_alternatives._windows(travelled, np.array([], np.intp)) == []
    P = se2.matrix(travelled, 0.0 * travelled, 0.0 * travelled)
    Q = P.copy()
    assert step_alternatives._differences(P, Q) == []
    Q[50] = Q[50] @ se2.matrix(0.0, 0.0, 0.3)  # only askew
    assert step_alternatives._differences(P, Q) == []
    Q[50:] = se2.matrix(0.5, 0.0, 0.0) @ P[50:]
    assert step_alternatives._differences(P, Q) == [(48, 53)]


def test_odometry_may_be_said_to_fail():
    recording = room(40).recording
    given = recording, prior(recording), slam.SlamOptions(), silent
    assert odometry_2d.register_scans(*given).diagnostics.odometry_faults == []
    matched = odometry_2d.register_scans(*given, faults=np.array([20]))
    assert matched.diagnostics.odometry_faults == [20]


def test_odometry_that_jumps_at_every_scan():
    simulation = room()
    jumps = np.random.default_rng(0).normal(size=(3, 80)) * [[0.5], [0.5], [0.3]]
    odometry = simulation.recording.T_odom_base @ se2.matrix(*jumps)
    recording = dataclasses.replace(simulation.recording, T_odom_base=odometry)
    estimated = slam.m_step(recording, prior(recording), slam.SlamOptions(), None, 1, silent)
    assert ate(estimated, simulation.truth) < 0.02


def test_odometry_is_followed_where_scan_matching_is_led_astray(monkeypatch):
    simulation = room()
    truth = simulation.truth.T_world_base
    recording = dataclasses.replace(simulation.recording, T_odom_base=truth)

    def lead_astray(*args, **keywords):
        matched = odometry_2d.register_scans(*args, **keywords)
        steps = se2.increments(matched.poses) @ se2.matrix(0.0, 0.0, np.radians(0.5))
        return dataclasses.replace(matched, poses=chained(steps))

    monkeypatch.setattr(M_STEP, "register_scans", lead_astray)
    for given, is_led_astray in ((recording, False), (recording.without_odometry(), True)):
        estimated = slam.m_step(given, prior(given), slam.SlamOptions(), None, 1, silent)
        assert (ate(estimated, simulation.truth) > 0.02) == is_led_astray
        assert estimated.diagnostics.follows_odometry != is_led_astray
    assert any("odometry alone" in warning for warning in stillmap.build(recording).warnings)


def test_an_iteration_keeps_poses_that_are_more_likely(monkeypatch):
    simulation = room()
    recording, options = with_drift(simulation.recording), slam.SlamOptions()
    e = prior(recording)
    first = slam.m_step(recording, e, options, None, 1, silent)

    def tear(*args, **keywords):
        matched = odometry_2d.register_scans(*args, **keywords)
        poses, wrong = matched.poses.copy(), se2.matrix(0.0, 0.0, 2.0)
        poses[40:] = poses[40] @ wrong @ se2.inverse(poses[40]) @ poses[40:]
        return dataclasses.replace(matched, poses=poses)

    monkeypatch.setattr(M_STEP, "register_scans", tear)
    torn = slam.m_step(recording, e, options, None, 1, silent)
    kept = slam.m_step(recording, e, options, None, 1, silent, earlier=first)
    assert ate(torn, simulation.truth) > 0.5
    assert ate(kept, simulation.truth) < 0.02


@pytest.mark.parametrize("first", [10, 18])
def test_odometry_stalls_along_a_corridor(first):
    # scans fit where the robot was before, too
    scene = scene_by_name("office", {"robot": {"scans": 400}})
    recording = picked(simulate(scene, 3).recording, np.arange(0, 400, 5))
    steps = se2.increments(recording.T_odom_base)
    steps[first : first + 4] = np.eye(3)
    stalled = dataclasses.replace(recording, T_odom_base=chained(steps))
    e = np.full(recording.n_beams, 0.9, np.float32)
    expected, estimated = (
        slam.m_step(given, e, SlamOptions(), None, 1, silent, with_grid=False).poses
        for given in (recording, stalled)
    )
    d = se2.parameters(se2.inverse(expected) @ estimated)
    assert np.hypot(d[:, 0], d[:, 1]).max() < 0.15
