"""Shapes tell people from walls where the history of a place does not; segments of scans."""

import functools

import numpy as np

from stillmap import em
from stillmap.core.chunks import ScanBeams
from stillmap.em.shape_evidence import (
    _BOTH_FARTHER,
    _MAX_LOG_RATIO,
    _UNKNOWN,
    N_SEGMENT_TYPES,
    _fit_shapes,
    classify_segments,
    count_segments,
)
from stillmap.sim import scene_by_name, simulate

RESOLUTION = 0.05


@functools.cache
def corridor(name, scans):
    return simulate(scene_by_name(name, {"robot": {"scans": scans}}), 3)


@functools.cache
def label(simulation, threads=1, *, with_shapes=True):
    recording, poses, options = simulation.recording, simulation.truth.T_world_base, em.EmOptions()
    found, _ = em.final_e_step(
        recording, poses, RESOLUTION, options, threads, with_shapes=with_shapes
    )
    return found.p_static


def log_loss(p, static):
    p = np.clip(p.astype(float), 1e-4, 1.0 - 1e-4)
    return -float(np.mean(np.log(np.where(static, p, 1.0 - p))))


def test_labels_are_better_than_by_history_alone():
    crowd = corridor("corridor-crowd", 250)
    hit, static = crowd.recording.hit, crowd.truth.static[crowd.recording.hit]
    found, by_history = label(crowd)[hit], label(crowd, with_shapes=False)[hit]
    assert log_loss(found, static) < 0.98 * log_loss(by_history, static)
    assert np.mean((found >= 0.5) != static) < np.mean((by_history >= 0.5) != static)
    # shapes never raise P(static): leaves of doors have the shape of walls
    assert (found <= by_history).all()
    assert np.mean(found < by_history) > 0.01
    # people who are seen for a moment, in places without a history that tells
    people = (by_history > 0.3) & (by_history < 0.7) & ~static
    assert people.sum() > 50
    assert np.mean(found[people] >= 0.5) < 0.6 * np.mean(by_history[people] >= 0.5)
    assert label(crowd, threads=3)[hit].tobytes() == found.tobytes()


def test_where_nobody_is_nothing_changes():
    empty = corridor("corridor-empty", 150)
    hit = empty.recording.hit
    last, without = label(empty)[hit], label(empty, with_shapes=False)[hit]
    assert np.mean(last < 0.5) <= np.mean(without < 0.5) + 1e-3
    np.testing.assert_allclose(last, without, atol=0.2)


def test_shares_of_segments():
    crowd = corridor("corridor-crowd", 250)
    recording, poses = crowd.recording, crowd.truth.T_world_base
    surfels = em.observations.build_surfel_map(recording, poses, RESOLUTION)
    shares = count_segments(surfels, recording, poses)
    assert shares.shape == (surfels.size, N_SEGMENT_TYPES)
    np.testing.assert_allclose(shares.sum(axis=1), 1.0, atol=1e-5)


def made_up(n=4000, seed=0):
    """Histories (n, 2) of static and dynamic surfels, half of which say nothing; one type each."""
    rng = np.random.default_rng(seed)
    static = rng.random(n) < 0.7
    tells = rng.random(n) < 0.5
    p = np.where(tells, np.where(static, 0.999, 0.001), 0.7)
    is_narrow = rng.random(n) < np.where(static, 0.1, 0.8)
    segments = np.zeros((n, N_SEGMENT_TYPES), np.float32)
    segments[np.arange(n), np.where(is_narrow, 0, 20)] = 1.0
    return static, np.column_stack([p, 1.0 - p]), is_narrow, segments


def fit(history, segments):
    log_ratio = _fit_shapes(history, segments, np.zeros(len(history), np.intp))
    np.testing.assert_array_equal(log_ratio[:, 0], 0.0)
    return log_ratio[:, 1]


def test_frequencies_are_learned_from_histories_that_tell():
    _, history, is_narrow, segments = made_up()
    log_ratio = fit(history, segments)
    # tempered by one half, and by those whose labels follow from the tempered ones
    for some, expected in ((is_narrow, np.log(0.8 / 0.1)), (~is_narrow, np.log(0.2 / 0.9))):
        share = log_ratio[some] / expected
        assert 0.25 < share.min() <= share.max() < 0.55


def test_without_a_history_that_tells_shapes_say_nothing():
    _, history, _, segments = made_up()
    history[:] = 0.7, 0.3
    np.testing.assert_allclose(fit(history, segments), 0.0, atol=1e-9)
    _, history, _, segments = made_up(6)  # nor do few surfels say much
    assert np.abs(fit(history, segments)).max() < 0.3


def test_shapes_never_decide_alone():
    static, history, _, segments = made_up()
    # everything static has one type, everything dynamic another one
    segments[:] = 0.0
    segments[np.arange(len(static)), np.where(static, 3, 7)] = 1.0
    log_ratio = fit(history, segments)
    assert 0.9 < np.abs(log_ratio).max() <= _MAX_LOG_RATIO
    assert (log_ratio > 0.0).tolist() == (~static).tolist()


def test_view_dependent_things_have_frequencies_of_their_own():
    """A post is as narrow as a leg; its history says that it is static, seen from some sides."""
    static, history, is_narrow, segments = made_up()
    view = static & is_narrow
    p = np.column_stack([history[:, 0] * ~view, history[:, 0] * view, history[:, 1]]) + 1e-6
    log_ratio = _fit_shapes(p, segments, np.zeros(len(p), np.intp))
    assert (log_ratio[is_narrow, 1] > 1.0).all()
    assert (np.abs(log_ratio[is_narrow, 2] - log_ratio[is_narrow, 1]) < 0.4).all()


STEP = np.radians(0.5)
NO_RETURN, UNUSABLE = 0.0, -1.0


def scans(*ranges):
    """Scans of beams half a degree apart; NO_RETURN: at 30 m without a return."""
    points, hit = [], []
    for some in ranges:
        some = np.asarray(some, float)
        angle = STEP * np.arange(len(some))
        reach = np.where(some == NO_RETURN, 30.0, np.where(some == UNUSABLE, np.nan, some))
        points.append(reach[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]))
        hit.append(some > 0.0)
    n = [len(some) for some in ranges]
    T = np.tile(np.eye(3), (len(n), 1, 1))
    ends = np.concatenate(points).astype(np.float32)
    return ScanBeams(ends, np.concatenate(hit), np.append(0, np.cumsum(n)), T)


def test_a_leg_before_a_wall():
    # 0.105 m wide; the wall goes on behind it, and beyond both ends of the scan
    found = classify_segments(scans([6.0] * 40 + [4.0] * 4 + [6.0] * 40))
    width, order = np.divmod(found, 4)
    assert (found >= 0).all()
    assert (found < N_SEGMENT_TYPES).all()
    assert set(order[40:44]) == {_BOTH_FARTHER}
    assert set(width[40:44]) == {0}
    assert set(order[:40]) == set(order[44:]) == {_UNKNOWN}
    assert set(width[:40]) == {5}  # 2 m


def test_scans_do_not_touch():
    row = [5.0] * 30
    alone = classify_segments(scans(row))
    for both in (scans(row, row), scans(row, [], row)):
        np.testing.assert_array_equal(classify_segments(both), np.tile(alone, 2))
    # nothing to classify
    assert classify_segments(scans([])).shape == (0,)
    assert (classify_segments(scans([NO_RETURN] * 9)) == -1).all()
    assert (classify_segments(scans([UNUSABLE] * 9)) == -1).all()
