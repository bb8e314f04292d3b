"""What is kept of a live run, its bound, and labels in hindsight."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

import stillmap
from stillmap.live.beam_store import BeamStore, join_parts
from stillmap.live.mapper import LiveMapper


def fill(max_bytes, scans, tmp_path):
    """A store of scans of 1 to 20 beams, each with its number."""
    store = BeamStore([(np.float32, (2,)), (np.int64, ())], tmp_path, max_bytes)
    for number in range(scans):
        n = 1 + number % 20
        store.append(number, [np.full((n, 2), number, np.float32), np.full(n, number)])
    return store


def test_all_scans_are_kept_without_a_bound(tmp_path):
    store = fill(None, 300, tmp_path)
    assert store.kept.tolist() == list(range(300))
    points, numbers = join_parts(store.parts(), tmp_path)
    np.testing.assert_array_equal(numbers, np.repeat(store.kept, store.counts))
    np.testing.assert_array_equal(points[:, 1], numbers)


@pytest.mark.parametrize("scans", [100, 3000, 20_000])
def test_scans_are_dropped_evenly_beyond_the_bound(scans, tmp_path):
    bound = 100_000
    store = fill(bound, scans, tmp_path)
    points, numbers = join_parts(store.parts(), tmp_path)
    np.testing.assert_array_equal(numbers, np.repeat(store.kept, store.counts))
    np.testing.assert_array_equal(points[:, 0], numbers)
    assert np.all(np.diff(store.kept) > 0)
    assert store.kept[-1] == scans - 1
    size = points.nbytes + numbers.nbytes
    assert size <= 1.1 * bound
    if scans * 10.5 * 16 < bound:
        assert len(store.kept) == scans
        return
    assert size > 0.3 * bound
    gaps = np.diff(store.kept)
    assert gaps.max() <= 8 * scans * 10.5 * 16 / bound  # none is much emptier than the mean
    assert gaps[0] > 1


@pytest.mark.parametrize(("bound", "scans"), [(1, 5000), (20_000, 10_000), (100_000, 40_000)])
def test_a_store_has_as_few_files_after_a_long_run(bound, scans, tmp_path):
    store = fill(bound, scans, tmp_path)
    assert len(store._segments) < 40
    numbers = join_parts(store.parts(), tmp_path)[1]
    assert store.kept[-1] == scans - 1
    np.testing.assert_array_equal(numbers, np.repeat(store.kept, store.counts))
    assert numbers.nbytes < max(1.1 * bound, 80_000)


def test_the_store_is_empty_at_first(tmp_path):
    store = BeamStore([(np.float32, (2,))], tmp_path, 10)
    assert len(store.kept) == len(join_parts(store.parts(), tmp_path)[0]) == 0


def test_parts_stay_while_more_is_appended(tmp_path):
    store = fill(20_000, 200, tmp_path)
    kept, counts, parts = store.kept, store.counts, store.parts()
    assert len(parts) > 1
    for number in range(200, 3000):
        store.append(number, [np.full((9, 2), number, np.float32), np.full(9, number)])
    store.close()
    points, numbers = join_parts(parts, tmp_path)
    np.testing.assert_array_equal(numbers, np.repeat(kept, counts))
    np.testing.assert_array_equal(points[:, 1], numbers)


def test_a_bounded_run_is_saved_with_fewer_scans(corridor, tmp_path):
    with LiveMapper({"threads": 1}, max_scratch=400_000) as mapper:
        for t, beams in enumerate(corridor.beams[:200]):
            update = mapper.push(beams, corridor.recording.T_odom_base[t])
        poses = mapper.poses
        assert len(poses) == 200
        np.testing.assert_array_equal(update.pose, corridor.updates[199].pose)
        mapper.save(tmp_path / "out")
        found = mapper.finish()
    saved = stillmap.load(tmp_path / "out")
    assert len(saved.poses) == len(found.poses) < 150
    np.testing.assert_allclose(saved.poses[-1], poses[-1], atol=1e-6)


def test_scans_are_labelled_once_more_after_the_lag(corridor):
    with LiveMapper({"threads": 1}, lag=2.0) as mapper:
        later = {}
        for t, beams in enumerate(corridor.beams[:120]):
            update = mapper.push(beams, corridor.recording.T_odom_base[t])
            for one in update.hindsight:
                later[one.number] = (t, one.p_static)
    assert sorted(later) == list(range(len(later)))
    stamps = corridor.recording.stamp_ns
    lags = [1e-9 * (stamps[now] - stamps[t]) for t, (now, _) in later.items()]
    assert 2.0 <= min(lags) <= max(lags) < 2.0 + 1e-9 * np.diff(stamps).max()
    wrong = {"at once": 0, "later": 0}
    for t, (_, p_static) in itertools.islice(later.items(), 20, None):
        moves, hit = ~corridor.truth.static[corridor.recording.beams_of(t)], corridor.beams[t].hit
        wrong["at once"] += np.sum(((corridor.updates[t].p_static < 0.5) != moves)[hit])
        wrong["later"] += np.sum(((p_static < 0.5) != moves)[hit])
    assert 0 < wrong["later"] < 0.9 * wrong["at once"]


def test_an_earlier_scan_is_labelled_as_it_was(corridor):
    """Where scans are a millisecond apart, as those of two lasers, poses do not tell the motion."""
    n = len(corridor.beams[0].points)
    times = np.linspace(0.0, 0.1, n, dtype=np.float32)
    with LiveMapper({"threads": 1}) as mapper:
        for t, beams in enumerate(corridor.beams[:60]):
            odometry = corridor.recording.T_odom_base[t]
            mapper.push(replace(beams, sensor="other"), odometry)
            last = replace(beams, stamp_ns=beams.stamp_ns + 10**6, beam_time=times)
            update = mapper.push(last, odometry)
        twist = mapper._slam.history.twist_at(2 * t + 1)
        again = mapper.label(last, 2 * t + 1)
    np.testing.assert_allclose(twist, 0.0, atol=1e-6)
    assert np.mean((again < 0.5) == (update.p_static < 0.5), where=last.hit) > 0.95


@pytest.mark.parametrize("settings", [{"max_scratch": 0}, {"max_scratch": 1000}, {"lag": 0.0}])
def test_wrong_bounds_are_named(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        LiveMapper(**settings)
