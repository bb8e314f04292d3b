"""A disk that is full while the robot drives: mapping goes on, and what fits is kept."""

import itertools
import shutil

import numpy as np
import pytest

import stillmap
from stillmap.core.errors import InputError
from stillmap.live import beam_store, history, spaced_scans
from stillmap.live.beam_store import BeamStore, join_parts
from stillmap.live.local_map import MappedScan
from stillmap.live.loop_process import LoopProcess
from stillmap.live.mapper import LiveMapper
from stillmap.live.scan import ScanBeams
from stillmap.live.spaced_scans import SpacedScans

FULL = 9_000  # bytes of each file: fewer than are written at once
FIELDS = [(np.float32, (2,)), (np.int64, ())]  # 16 bytes a beam


def append(store, numbers, beams=50):
    for number in numbers:
        store.append(number, [np.full((beams, 2), number, np.float32), np.full(beams, number)])


def kept_of(store, tmp_path):
    """The numbers of the scans that are kept, of which all beams are there."""
    kept, counts = store.kept, store.counts
    points, numbers = join_parts(store.parts(), tmp_path)
    np.testing.assert_array_equal(numbers, np.repeat(kept, counts))
    np.testing.assert_array_equal(points[:, 1], numbers)
    return kept


@pytest.fixture
def small_memory(monkeypatch):
    monkeypatch.setattr(beam_store, "QUICKLY_WRITTEN", 10_000)
    monkeypatch.setattr(beam_store, "_free_bytes", lambda _: 0)
    monkeypatch.setattr(beam_store, "_IN_MEMORY_IF_FULL", 1_600_000)
    return 1_600_000


def test_scans_are_dropped_evenly_while_the_disk_is_full(
    tmp_path, limit_files, small_memory, caplog
):
    store = BeamStore(FIELDS, tmp_path, None)
    append(store, range(5000))
    limit_files(FULL)
    append(store, range(5000, 13_000))
    held = sum(segment.memory_bytes for segment in store._segments)
    assert held < 1.2 * small_memory
    limit_files(None)
    kept = kept_of(store, tmp_path)
    assert kept[:5000].tolist() == list(range(5000))
    assert kept[-1] == 12_999
    assert np.diff(kept).max() <= 16  # of 8000 scans there is room for 2000
    assert store.was_full
    assert len(caplog.records) == 1
    assert "mapping goes on" in caplog.text
    store.close()


def test_all_scans_are_kept_again_once_there_is_room(tmp_path, limit_files, small_memory):
    store = BeamStore(FIELDS, tmp_path, None)
    limit_files(FULL)
    append(store, range(4000))
    assert store.was_full
    limit_files(None)
    append(store, range(4000, 10_000))
    assert sum(segment.memory_bytes for segment in store._segments) < 1.2 * small_memory
    kept = kept_of(store, tmp_path)
    assert np.count_nonzero(kept >= 4000) == 6000
    assert len(store._segments) < 20
    store.close()


def test_a_bounded_store_stays_even_on_a_full_disk(tmp_path, limit_files, small_memory):
    bound = 2 * small_memory
    store = BeamStore(FIELDS, tmp_path, bound)
    append(store, range(8000))
    limit_files(FULL)
    append(store, range(8000, 20_000))
    limit_files(None)
    kept = kept_of(store, tmp_path)
    assert store.was_full
    assert kept[-1] == 19_999
    assert np.diff(kept).max() <= 64
    assert len(kept) * 800 > 0.3 * small_memory
    store.close()


def test_a_drive_goes_on_while_the_disk_is_full(corridor, tmp_path, limit_files, caplog):
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    odometry, count = corridor.recording.T_odom_base, 200
    with LiveMapper({"threads": 1}, scratch=scratch) as mapper:
        for t, beams in enumerate(corridor.beams[:count]):
            if t == 50:
                limit_files(100_000)
            update = mapper.push(beams, odometry[t])
            np.testing.assert_array_equal(update.pose, corridor.updates[t].pose)
            np.testing.assert_array_equal(update.p_static, corridor.updates[t].p_static)
        assert len(mapper.poses) == count
        limit_files(None)
        shutil.rmtree(scratch)  # only the disk of the result has room
        mapper.save(tmp_path / "out")
        assert len(mapper.objects) > 0
    assert len(stillmap.load(tmp_path / "out").poses) == count
    given = np.load(tmp_path / "out/live/beams/p_static.npy")
    np.testing.assert_array_equal(given, corridor.p_static[: len(given)])
    assert sum("mapping goes on" in record.getMessage() for record in caplog.records) == 1


def test_a_result_says_that_scans_are_missing(corridor, tmp_path, limit_files, monkeypatch):
    monkeypatch.setattr(beam_store, "_IN_MEMORY_IF_FULL", 800_000)
    with LiveMapper({"threads": 1}, scratch=tmp_path) as mapper:
        limit_files(150_000)
        for t, beams in enumerate(corridor.beams):
            mapper.push(beams, corridor.recording.T_odom_base[t])
        limit_files(None)
        mapper.save(tmp_path / "out")
    saved = stillmap.load(tmp_path / "out")
    assert 50 < len(saved.poses) < len(corridor.beams)
    (told,) = [what for what in saved.run["warnings"] if "full" in what]
    assert f"{len(corridor.beams)} scans {len(saved.poses)} were kept" in told


def test_answers_to_dropped_scans_are_dropped(corridor, tmp_path, limit_files, monkeypatch):
    monkeypatch.setattr(beam_store, "_IN_MEMORY_IF_FULL", 400_000)
    monkeypatch.setattr(history, "_IN_MEMORY_IF_FULL", 20_000)
    odometry, count = corridor.recording.T_odom_base, len(corridor.beams)
    with LiveMapper({"threads": 1}, scratch=tmp_path, lag=1.0) as mapper:
        limit_files(150_000)
        for t, beams in enumerate(corridor.beams):
            mapper.push(beams, odometry[t])
        kept = mapper._slam.history
        dropped, poses = kept.dropped, mapper.poses
        assert 20 < len(dropped) < count
        assert kept._answers.memory_bytes < (count - len(dropped) // 2) * 264
        assert not np.isin(dropped, kept.snapshot().number).any()
        known = np.setdiff1d(np.arange(count), dropped)
        # others than spaced scans are where the graph bends between these
        np.testing.assert_allclose(poses[known], corridor.mapper.poses[known], atol=1e-3)
        assert np.isnan(poses[dropped]).all()
        with pytest.raises(InputError, match="was dropped"):
            mapper.label(corridor.beams[dropped[0]], int(dropped[0]))
        limit_files(None)
        mapper.save(tmp_path / "out")
    saved = stillmap.load(tmp_path / "out")
    expected = poses[kept_numbers(tmp_path / "out", corridor)]
    np.testing.assert_allclose(saved.poses, expected, atol=1e-6)


def kept_numbers(folder, run):
    """Numbers of the scans of a result, by their stamps."""
    stamps = np.loadtxt(folder / "live/trajectory.tum")[:, 0]
    every = 1e-9 * run.recording.stamp_ns
    return np.abs(every[:, None] - stamps).argmin(axis=0)


def test_loops_are_closed_beside_while_the_disk_is_full(corridor, tmp_path, limit_files):
    limit_files(100_000)
    with LiveMapper({"threads": 1}, scratch=tmp_path, background=True) as mapper:
        odometry = corridor.recording.T_odom_base
        for t, beams in enumerate(itertools.islice(corridor.beams, 300)):
            mapper.push(beams, odometry[t])
        closer = mapper._slam.frame._closer
        assert isinstance(closer, LoopProcess)
        closer.poll()
        assert not closer._process.has_ended
        limit_files(None)


def spaced_scan(number, beams=200):
    points = np.stack([np.full(beams, number), np.arange(beams)], axis=1).astype(np.float32)
    scan = ScanBeams(10**9 * number, points, np.ones(beams, bool), np.eye(3), 0)
    return MappedScan(scan, np.full(beams, 0.5, np.float32), np.eye(3), float(number))


def test_spaced_scans_in_memory_are_bounded_and_stay_even(tmp_path, limit_files, monkeypatch):
    most = 1_000_000
    monkeypatch.setattr(spaced_scans, "_IN_MEMORY_IF_FULL", most)
    monkeypatch.setattr(spaced_scans, "_LITTLE", 300_000)
    scans = SpacedScans(2, tmp_path)
    for number in range(2000):
        if number == 300:
            limit_files(500_000)
        if number == 1800:
            limit_files(None)
        scans.append(spaced_scan(number), 1.0, np.zeros((3, 3)))
        assert sum(one.memory_bytes for one in scans._arrays[1:]) <= most + 3000
        if number % 100 == 0:
            scans.view()  # as loops are searched on the way
    view = scans.view()
    counts = np.diff(view.recording.offset)
    assert len(counts) == 2000
    assert (counts[:300] == 200).all()
    assert (counts[-100:] == 200).all()
    thinned = counts[600:1700]
    assert thinned.min() >= 50
    assert thinned.max() <= 2 * thinned.min() + 1
    np.testing.assert_array_equal(view.recording.points[:, 0], np.repeat(np.arange(2000), counts))
    one = scans.scan(view, 1000)
    np.testing.assert_array_equal(one.beams.points[:, 1], np.arange(0, 200, 200 // counts[1000]))
    assert len(one.e) == counts[1000]
    scans.close()
