"""The live mapper on a simulated corridor: causal poses, labels and map."""

import json

import numpy as np
import pytest
from live_runs import answers, distances_to_walls, poses_of, push_all

import stillmap
from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.em.options import EmOptions
from stillmap.live.causal_labels import CausalLabels, take_over
from stillmap.live.mapper import LiveMapper
from stillmap.live.scan import Observation, to_beams
from stillmap.results.eval.trajectory import compute_absolute_errors


@pytest.fixture
def fresh():
    """Makes mappers, which are closed after the test."""
    made = []

    def make(**settings):
        made.append(LiveMapper({"threads": 1}, **settings))
        return made[-1]

    yield make
    for mapper in made:
        mapper.close()


def f1(p_static, static, use):
    says, moves = (p_static < 0.5)[use], ~static[use]
    return 2 * (says & moves).sum() / (says.sum() + moves.sum())


def test_poses_and_labels_are_those_of_the_truth(corridor):
    errors = compute_absolute_errors(corridor.poses, corridor.truth.T_world_base)
    assert errors.rmse < 0.05
    assert errors.max < 0.15
    assert f1(corridor.p_static, corridor.truth.static, corridor.recording.hit) > 0.85
    assert np.isnan(corridor.p_static[np.isnan(corridor.recording.points).any(axis=1)]).all()
    for t in (0, 100, 399):
        T = corridor.updates[t].T_map_odom @ corridor.recording.T_odom_base[t]
        np.testing.assert_allclose(T, corridor.updates[t].pose, atol=1e-9)


def test_poses_and_path_as_they_are_known_at_the_end(corridor):
    poses, path = corridor.mapper.poses, corridor.mapper.path
    assert len(poses) == corridor.recording.n_scans
    assert compute_absolute_errors(poses, corridor.truth.T_world_base).rmse < 0.05
    np.testing.assert_allclose(poses[-1], corridor.updates[-1].pose, atol=1e-9)
    assert 20 < len(path) < len(poses)
    assert np.linalg.norm(np.diff(path[:, :2, 2], axis=0), axis=1).max() < 0.5
    nearest = np.linalg.norm(path[:, None, :2, 2] - poses[None, :, :2, 2], axis=2).min(axis=1)
    assert nearest.max() < 1e-6


def test_the_map_shows_walls_and_nobody(corridor):
    T = corridor.truth.T_world_base[0]  # the map has the frame of the first scan
    distance = distances_to_walls(corridor.mapper.map, corridor.truth, T)
    assert len(distance) > 500
    assert np.mean(distance > 0.15) < 0.03


def test_changed_parts_of_the_map_are_told(corridor):
    changes = [update.changes for update in corridor.updates]
    count = np.array(list(map(len, changes)))
    tiles = {tuple(change.first_cell.tolist()) for several in changes for change in several}
    seconds = 1e-9 * np.ptp(corridor.recording.stamp_ns)
    assert len(tiles) < count.sum() < 1.5 * len(tiles) * (seconds + 1.0)  # each once a second
    assert count.max() <= max(8, len(tiles) / 4)  # never all at once
    first = next(filter(None, changes))[0]
    assert first.p_occupied.shape == (32, 32)
    assert np.all(first.first_cell % 32 == 0)


def test_parts_that_emptied_are_told():
    """Where a correction moves all cells."""
    labels = CausalLabels(2, 0.05, EmOptions())
    angles = np.linspace(-1.0, 1.0, 200)
    beams = to_beams(stillmap.Scan(0, np.full(200, 3.0), angles))
    labels.add(Observation(beams, np.eye(3), np.full(200, 0.1, np.float32)), np.eye(3))
    before = {tuple(change.first_cell) for change in labels.take_changes(0)}
    moved = labels.filter.sibling()
    take_over(moved, labels.filter, se2.matrix(2.0, 0.0, 0.0)[None], 0, labels.filter.block_count)
    labels.filter = moved
    changes = {tuple(change.first_cell): change.p_occupied for change in labels.take_changes(10**9)}
    emptied = {cell for cell, p in changes.items() if np.isnan(p).all()}
    assert before <= changes.keys()
    assert emptied
    assert emptied <= before
    known = np.concatenate([p[~np.isnan(p)] for p in changes.values()])
    expected = labels.to_map().p_occupied
    np.testing.assert_array_equal(np.sort(known), np.sort(expected[~np.isnan(expected)]))
    assert labels.take_changes(2 * 10**9) == []


def test_a_saved_run_is_a_result(corridor, tmp_path):
    corridor.mapper.save(tmp_path / "out")
    saved = stillmap.load(tmp_path / "out")
    np.testing.assert_allclose(saved.poses, corridor.mapper.poses, atol=1e-6)
    given = np.load(tmp_path / "out/live/beams/p_static.npy")
    np.testing.assert_array_equal(given, corridor.p_static)
    lines = (tmp_path / "out/live/trajectory.tum").read_text().splitlines()
    assert len(lines) == corridor.recording.n_scans
    assert json.loads((tmp_path / "out/run.json").read_text())["counts"]["scans"] == len(lines)
    with pytest.raises(stillmap.InputError, match="out"):
        corridor.mapper.save(tmp_path / "out")


def test_finishing_is_building(corridor):
    found = corridor.mapper.finish()
    built = stillmap.build(corridor.recording, {"threads": 1})
    np.testing.assert_array_equal(found.poses, built.poses)
    np.testing.assert_array_equal(found.p_static, built.p_static)
    errors = compute_absolute_errors(found.poses, corridor.truth.T_world_base)
    assert errors.rmse < 0.03
    assert f1(found.p_static, corridor.truth.static, corridor.recording.hit) > 0.95


def test_without_odometry(corridor):
    updates = answers(corridor.recording.without_odometry(), 150)
    assert all(update.T_map_odom is None for update in updates)
    poses = poses_of(updates)
    assert compute_absolute_errors(poses, corridor.truth.T_world_base[:150]).rmse < 0.06


def test_scans_that_are_refused_change_nothing(corridor, fresh):
    first, second = corridor.beams[:2]
    mapper = fresh(background=True)
    with pytest.raises(ValueError, match="odometry"):
        mapper.push(second, (0.0, np.nan, 0.0))
    assert mapper._slam is None
    mapper.push(second)
    with pytest.raises(ValueError, match="stamp"):
        mapper.push(first)
    assert len(mapper.poses) == 1


def test_before_the_first_scan_and_after_the_end(corridor, tmp_path):
    mapper = LiveMapper({"threads": 1})
    assert mapper.poses.shape == mapper.path.shape == (0, 3, 3)
    assert mapper.map.p_occupied.size == len(mapper.cells.cells) == 0
    calls = [mapper.finish, lambda: mapper.save(tmp_path / "out")]
    for call in calls:
        with pytest.raises(InputError, match="no scan"):
            call()
    mapper.push(corridor.beams[0])
    mapper.close()
    mapper.close()
    for call in (*calls, lambda: mapper.push(corridor.beams[1]), lambda: mapper.poses):
        with pytest.raises(ValueError, match="closed"):
            call()


def test_loops_are_closed_in_the_background(corridor, fresh):
    mapper = fresh(background=True)
    updates = push_all(mapper, corridor.recording)
    poses = poses_of(updates)
    assert compute_absolute_errors(poses, corridor.truth.T_world_base).rmse < 0.06
    assert compute_absolute_errors(mapper.poses, corridor.truth.T_world_base).rmse < 0.06


def test_a_covariance_follows_the_axes_of_its_frame():
    turn = se2.matrix(1.0, 2.0, np.pi / 2)
    found = se2.rotate_covariance(np.diag([4.0, 1.0, 0.1]), turn)
    np.testing.assert_allclose(found, np.diag([1.0, 4.0, 0.1]), atol=1e-12)
    T = np.eye(4)
    T[:2, :2] = turn[:2, :2]
    found = se2.rotate_covariance(np.diag([4.0, 1.0, 2.0, 0.4, 0.1, 0.2]), T)
    np.testing.assert_allclose(found, np.diag([1.0, 4.0, 2.0, 0.1, 0.4, 0.2]), atol=1e-12)


def test_answers_do_not_depend_on_when_the_map_is_updated(corridor):
    odometry, count = corridor.recording.T_odom_base, 120
    with LiveMapper({"threads": 1}) as mapper:
        for t, beams in enumerate(corridor.beams[:count]):
            update, expected = mapper.push(beams, odometry[t]), corridor.updates[t]
            assert len(mapper._mapping.history) == t  # the answer came before
            mapper.update_map()
            mapper.update_map()
            assert len(mapper._mapping.history) == t + 1
            np.testing.assert_array_equal(update.pose, expected.pose)
            np.testing.assert_array_equal(update.p_static, expected.p_static)
            assert len(update.changes) == len(expected.changes)
        update.p_static[:] = update.pose[:] = 0.0  # of the user from now on
        snapshot = mapper.snapshot()
    last = corridor.updates[count - 1]
    np.testing.assert_array_equal(snapshot.p_static[-len(last.p_static) :], last.p_static)
    np.testing.assert_array_equal(snapshot.given[-1], last.pose)
    assert snapshot.recording.n_scans == count


def test_mapping_goes_on_when_the_process_that_closes_loops_dies(corridor, fresh, caplog):
    mapper = fresh(background=True)
    push_all(mapper, corridor.recording, 50)
    process = mapper._slam.frame._closer._process
    process.kill()
    process.wait()
    waiting = []
    for t in range(50, 150):
        update = mapper.push(corridor.beams[t], corridor.recording.T_odom_base[t])
        waiting.append(mapper._slam.frame._closer._outgoing.qsize())
    truth = corridor.truth.T_world_base
    moved = se2.inverse(truth[0]) @ truth[149]
    np.testing.assert_allclose(update.pose[:2, 2], moved[:2, 2], atol=0.1)
    assert sum("closes loops" in record.message for record in caplog.records) == 1
    assert waiting[-1] <= waiting[10]  # nobody takes anything out
