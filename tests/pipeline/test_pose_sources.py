"""Poses compared with odometry alone and with scans alone."""

import dataclasses
import json

import numpy as np
import pytest

import stillmap
from stillmap import slam
from stillmap.core import se2
from stillmap.core.profiling import StageTimer, no_progress
from stillmap.pipeline import pose_sources
from stillmap.pipeline.em_loop import EmState
from stillmap.pipeline.options import DEFAULTS, resolve_options
from stillmap.results.eval.trajectory import compute_absolute_errors
from stillmap.results.writer import save


@pytest.fixture
def recording(room):
    """The room with odometry that is true to the millimetre."""
    return dataclasses.replace(room.recording, T_odom_base=room.truth.T_world_base)


def state_after(recording, poses, **diagnostics):
    """An EM that converged at given poses."""
    options = resolve_options(DEFAULTS, recording)
    state = EmState(options)
    state.update(next(stillmap.iterate(recording, options, poses=poses)))
    m_step = dataclasses.replace(state.best.m_step, diagnostics=slam.Diagnostics(**diagnostics))
    state.best = dataclasses.replace(state.best, m_step=m_step)
    return state


def compare(recording, state):
    return pose_sources.better_source(recording, state, no_progress, StageTimer())


def bent(poses, degrees=0.5):
    """Poses that turn too much, so many degrees at every scan."""
    steps = se2.inverse(poses[:-1]) @ poses[1:] @ se2.matrix(0.0, 0.0, np.radians(degrees))
    out = [poses[0]]
    for step in steps:
        out.append(out[-1] @ step)
    return np.array(out)


def test_odometry_is_taken_where_poses_are_worse(recording):
    state = state_after(recording, bent(recording.T_odom_base))
    found = compare(recording, state)
    assert found.record.source == "odometry"
    assert found.record.number == 2
    assert found.record.held_out_log_likelihood > state.records[0].held_out_log_likelihood
    errors = compute_absolute_errors(found.estimate.poses, recording.T_odom_base)
    assert errors.rmse < 1e-9
    np.testing.assert_array_equal(found.estimate.poses[0], np.eye(3))


def test_scores_below_zero(recording, monkeypatch):
    """Where the map predicts worse than none, odometry is compared as elsewhere."""
    state = state_after(recording, bent(recording.T_odom_base, 5.0))
    assert compare(recording, state).record.source == "odometry"
    [record] = state.records
    state.records = [dataclasses.replace(record, held_out_log_likelihood=-0.5)]
    monkeypatch.setattr(pose_sources, "_held_out", lambda *_: -0.4)
    assert compare(recording, state).record.source == "odometry"
    monkeypatch.setattr(pose_sources, "_held_out", lambda *_: -0.8)
    assert compare(recording, state) is None


def test_good_poses_are_kept(recording):
    worse = dataclasses.replace(recording, T_odom_base=bent(recording.T_odom_base))
    assert compare(worse, state_after(worse, recording.T_odom_base)) is None


def lagging(poses, first, last, share):
    """Poses that move by a share of the way only in some of the steps."""
    steps = se2.inverse(poses[:-1]) @ poses[1:]
    steps[first:last, :2, 2] *= share
    out = [poses[0]]
    for step in steps:
        out.append(out[-1] @ step)
    return np.array(out)


def test_odometry_is_taken_in_a_stretch_where_poses_lag(recording):
    """Odometry that drifts is worse than scan matching elsewhere."""
    drifting = dataclasses.replace(recording, T_odom_base=bent(recording.T_odom_base, 0.7))
    state = state_after(drifting, lagging(recording.T_odom_base, 25, 40, 0.3))
    found = compare(drifting, state)
    assert found.record.source == "odometry_in_stretches"
    assert found.record.bound > state.records[0].bound
    assert compute_absolute_errors(found.estimate.poses, recording.T_odom_base).rmse < 0.03


def test_a_stretch_is_kept_where_odometry_is_wrong(recording):
    """Scan matching goes on as before after the labels of the other hypothesis."""
    wrong = lagging(recording.T_odom_base, 25, 40, 0.3)
    found = compare(
        dataclasses.replace(recording, T_odom_base=wrong),
        state_after(recording, recording.T_odom_base),
    )
    if found is not None:
        errors = compute_absolute_errors(found.estimate.poses, recording.T_odom_base)
        assert errors.rmse < 0.03


@pytest.mark.parametrize("missing", ["odometry", "estimator", "score"])
def test_where_nothing_can_be_compared(recording, missing):
    state, given = state_after(recording, bent(recording.T_odom_base)), recording
    if missing == "odometry":
        given = recording.without_odometry()
    elif missing == "estimator":
        state.options = dataclasses.replace(state.options, estimator="paper")
    else:
        state.records = [dataclasses.replace(state.records[0], held_out_log_likelihood=None)]
    assert compare(given, state) is None


def test_em_goes_on_from_the_source_and_says_so(recording, monkeypatch, tmp_path):
    """Every M-step is led astray until odometry's poses were labelled."""
    real, initial = slam.m_step, []

    def astray(*args, earlier_poses=None, **kwargs):
        found = real(*args, earlier_poses=earlier_poses, **kwargs)
        initial.append(kwargs.get("initial"))
        if earlier_poses is not None and np.allclose(earlier_poses, by_odometry):
            return found
        return dataclasses.replace(found, poses=bent(found.poses, 2.0))

    by_odometry = se2.inverse(recording.T_odom_base[0]) @ recording.T_odom_base
    monkeypatch.setattr("stillmap.pipeline.em_loop.slam.m_step", astray)
    result = stillmap.build(recording)
    sources = [record.source for record in result.iterations]
    at = sources.index("odometry")
    assert at == len(sources) - 2
    assert initial[at] is None  # all scans are matched again
    assert compute_absolute_errors(result.poses, recording.T_odom_base).rmse < 0.02
    assert any("odometry alone" in text for text in result.warnings)
    save(result, tmp_path / "map")
    run = json.loads((tmp_path / "map" / "run.json").read_text())
    assert run["iterations"][at]["source"] == "odometry"
    assert "source" not in run["iterations"][0]


@pytest.mark.parametrize(("share", "is_refined"), [(0.1, True), (0.5, False)])
def test_all_scans_are_matched_anew_where_many_labels_changed(
    recording, monkeypatch, share, is_refined
):
    """From the third iteration on; before, they always are."""
    real, initial = slam.m_step, []

    def recorded(*args, **kwargs):
        initial.append(kwargs["initial"])
        return real(*args, **kwargs)

    monkeypatch.setattr("stillmap.pipeline.em_loop.slam.m_step", recorded)
    monkeypatch.setattr("stillmap.pipeline.em_loop.em.touched_share", lambda *_: share)
    iterations = stillmap.iterate(recording)
    for _ in range(3):
        next(iterations)
    assert [one is not None for one in initial] == [False, False, is_refined]
