"""Stretches in which scan matching and odometry differ by more than noise adds up to."""

import numpy as np
import pytest

from stillmap.core import se2
from stillmap.slam.odometry_agreement import find_differences, replace_stretches
from stillmap.slam.options import OdometryOptions
from stillmap.slam.types import Diagnostics

T, STEP = 120, 0.08  # scans, m
STAMP = np.arange(T) * 200_000_000  # 5 scans per second: 20 in a window
LAG = slice(50, 70)  # steps of which scan matching loses a quarter
OPTIONS = OdometryOptions()


def chain(steps):
    out = [np.eye(3)]
    for step in steps:
        out.append(out[-1] @ step)
    return np.array(out)


@pytest.fixture
def steps():
    """An arc: 0.4 m and 0.1 rad per second."""
    return np.tile(se2.matrix(STEP, 0.0, 0.02), (T - 1, 1, 1))


@pytest.fixture
def lagging(steps):
    out = np.array(steps)
    out[LAG, :2, 2] *= 0.75
    return out


def test_a_lag_is_found(steps, lagging):
    found = find_differences(lagging, steps, STAMP, OPTIONS)
    assert found[LAG].all()
    # windows reach beyond it by less than their length
    assert not found[: LAG.start - 20].any()
    assert not found[LAG.stop + 20 :].any()


@pytest.mark.parametrize("change", ["heading", "scale", "noise"])
def test_usual_errors_of_odometry_are_no_difference(steps, change):
    measured = np.array(steps)
    if change == "heading":
        measured = measured @ se2.matrix(0.0, 0.0, 0.05)
    elif change == "scale":
        measured[:, :2, 2] *= 1.03
    else:
        noise = np.random.default_rng(0).normal(scale=0.02, size=(2, T - 1))
        measured = measured @ se2.matrix(*noise, np.zeros(T - 1))
    assert not find_differences(steps, measured, STAMP, OPTIONS).any()


def test_a_robot_that_stands_differs_by_noise_only():
    still = np.tile(np.eye(3), (T - 1, 1, 1))
    noise = np.random.default_rng(1).normal(scale=0.01, size=(2, T - 1))
    assert not find_differences(still, se2.matrix(*noise, np.zeros(T - 1)), STAMP, OPTIONS).any()


def test_the_motion_of_odometry_in_the_stretch(steps, lagging):
    odometry, poses = se2.matrix(3.0, 1.0, 2.0) @ chain(steps), chain(lagging)
    found = replace_stretches(poses, odometry, STAMP, Diagnostics(), OPTIONS)
    np.testing.assert_allclose(found, chain(steps), atol=1e-9)
    before = slice(0, LAG.start - 20)
    np.testing.assert_allclose(found[before], poses[before], atol=1e-12)


def test_odometry_that_differs_nearly_everywhere_is_no_judge(steps):
    slow = np.array(steps)
    slow[20:110, :2, 2] *= 0.5
    assert replace_stretches(chain(slow), chain(steps), STAMP, Diagnostics(), OPTIONS) is None


def test_nothing_to_replace(steps):
    poses = chain(steps)
    assert replace_stretches(poses, poses, STAMP, Diagnostics(), OPTIONS) is None


@pytest.mark.parametrize("what", ["faults", "break", "leap"])
def test_stretches_that_are_decided_stay(steps, lagging, what):
    odometry, diagnostics = np.array(steps), Diagnostics()
    if what == "faults":
        diagnostics = Diagnostics(odometry_faults=list(range(50, 70)))
    elif what == "break":
        diagnostics = Diagnostics(breaks=[60])
    else:
        odometry[60, :2, 2] = 5.0
    poses = chain(lagging)
    assert replace_stretches(poses, chain(odometry), STAMP, diagnostics, OPTIONS) is None


def test_a_few_faults_do_not_decide(steps, lagging):
    diagnostics = Diagnostics(odometry_faults=[60, 61])
    found = replace_stretches(chain(lagging), chain(steps), STAMP, diagnostics, OPTIONS)
    np.testing.assert_allclose(found, chain(steps), atol=1e-9)
