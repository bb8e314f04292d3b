"""What a calibration changes in a recording, and what it leaves."""

import dataclasses
import math

import numpy as np
import pytest

import stillmap
from stillmap.core import config, se2
from stillmap.core.source import Source
from stillmap.pipeline.calibration import calibrate_recording
from stillmap.prepare.lasers import mirror_beams
from stillmap.sim import scene_by_name, simulate

OPTIONS = config.override(stillmap.Options(), {"threads": 1})


@pytest.fixture(scope="module")
def simulation():
    return simulate(scene_by_name("office", {"robot": {"scans": 300}}), 4)


def turned(recording):
    return dataclasses.replace(recording, T_base_sensor=se2.matrix([0.08], [0.0], [1.0]))


def test_a_recording_that_is_right_is_not_touched(simulation):
    recording, found, sentences = calibrate_recording(simulation.recording, OPTIONS)
    assert recording is simulation.recording
    assert found.windows > 0
    assert sentences == []


def test_a_turned_laser(simulation):
    recording, _, sentences = calibrate_recording(turned(simulation.recording), OPTIONS)
    x, y, theta = se2.parameters(recording.T_base_sensor[0])
    assert abs(theta) < 0.02
    assert (x, y) == pytest.approx((0.08, 0.0))
    assert recording.T_odom_base is simulation.recording.T_odom_base
    (sentence,) = sentences
    assert "57.3 as recorded" in sentence


@pytest.mark.parametrize(
    ("notes", "options"),
    [
        ({}, {"laser_theta": 1.0}),
        ({"extrinsics": {"how": "TF from base_link to laser"}}, {}),
        ({"extrinsics": {"how": "PARAM"}}, {}),
    ],
)
def test_what_was_told_stays(simulation, notes, options):
    source = Source.from_dict({"sensors": [notes]})
    recording = dataclasses.replace(turned(simulation.recording), source=source)
    given = config.override(OPTIONS, {"read": options})
    after, found, _ = calibrate_recording(recording, given)
    assert np.array_equal(after.T_base_sensor[0, :2, :2], recording.T_base_sensor[0, :2, :2])
    assert "theta" not in found.lasers[0]


@pytest.mark.slow
def test_the_result_is_that_of_the_corrected_recording(simulation):
    mirrored = mirror_beams(simulation.recording, 0)
    result, told = (stillmap.build(one, OPTIONS) for one in (mirrored, simulation.recording))
    assert np.array_equal(result.poses, told.poses)
    assert np.array_equal(result.p_static, told.p_static, equal_nan=True)
    assert result.calibration.upside_down == [True]
    assert any("upside down" in text for text in result.warnings)
    assert "calibration" in result.stages


def test_given_poses_are_not_calibrated(simulation):
    recording = turned(simulation.recording)
    result = stillmap.build(recording, OPTIONS, poses=simulation.truth.T_world_base)
    assert result.calibration.windows == 0
    assert math.isclose(se2.parameters(result.recording.T_base_sensor[0])[2], 1.0)
