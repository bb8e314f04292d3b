"""The figure of quality without truth: what it depends on, and which way."""

import dataclasses

import numpy as np
import pytest
from recordings import of_one_sensor
from rooms import drive

from stillmap import em
from stillmap.core import chunks, se2
from stillmap.em.quality import select_held_out_scans
from stillmap.sim.walls import box

RESOLUTION, EVERY = 0.05, 10


@pytest.fixture(scope="module")
def room():
    walls = *box(0, 0, 9, 7), *box(1.5, 1.6, 0.9, 0.6)
    laser = {"beams": 180, "range_noise": 0.01, "max_range": 8.0}
    sim = drive(np.random.default_rng(4), walls, people=6, laser=laser, robot={"scans": 120})
    assert (sim.truth.mover >= 0).sum() > 500
    return sim


def figure(sim, e=None, poses=None, recording=None, every=EVERY, **more):
    e = sim.truth.static.astype(np.float32) if e is None else e
    poses = sim.truth.T_world_base if poses is None else poses
    return em.score_held_out_scans(recording or sim.recording, poses, e, RESOLUTION, every, **more)


def test_true_labels_and_poses_score_best(room):
    static, T = room.truth.static, room.truth.T_world_base
    rng = np.random.default_rng(0)
    e = static.astype(np.float32)
    best = figure(room)
    assert 0.5 < best < 6
    assert best > figure(room, np.ones_like(e)) + 0.02  # movers left in the map
    assert best > figure(room, np.full_like(e, 0.5)) + 0.1  # undecided
    assert best > figure(room, 1 - e) + 1  # walls left out of it
    wrong = rng.random(len(e)) < 0.2
    assert best > figure(room, np.where(wrong, 0, e).astype(np.float32)) + 0.02
    shaken = [T @ se2.matrix(*(off * rng.standard_normal((3, len(T))))) for off in (0.03, 0.1, 0.3)]
    scores = [best, *(figure(room, poses=poses) for poses in shaken)]
    assert np.diff(scores).max() < -0.05


def test_held_out_beams_are_not_in_the_map(room):
    held = select_held_out_scans(room.recording.n_scans, EVERY)
    of_held = np.repeat(held, np.diff(room.recording.offset))
    e = room.truth.static.astype(np.float32)
    assert figure(room, np.where(of_held, 1 - e, e)) == figure(room, e)
    assert figure(room, np.where(of_held, e, 1 - e)) != figure(room, e)


def test_no_score_without_held_out_scans(room):
    assert figure(room, every=0) is None
    assert figure(room, every=121) is None
    assert figure(room, every=120) is not None
    r = room.recording
    blind = dataclasses.replace(r, points=np.full_like(r.points, np.nan), hit=np.zeros_like(r.hit))
    assert figure(room, recording=blind) is None


def test_threads_and_chunks_change_nothing(room, monkeypatch):
    expected = figure(room)
    monkeypatch.setattr(chunks, "CHUNK_BEAMS", 1000)
    assert figure(room, threads=3) == pytest.approx(expected, rel=1e-12)


def test_in_three_dimensions():
    # a sensor in a cube of 4 m: three scans, the one in the middle held out
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(3 * 4000, 3))
    points = (2 * directions / np.abs(directions).max(axis=1, keepdims=True)).astype(np.float32)
    recording = of_one_sensor(np.arange(3), np.arange(4) * 4000, points, np.ones(12_000, bool))
    poses = np.tile(np.eye(4), (3, 1, 1))
    e = np.ones(len(points), np.float32)
    good = em.score_held_out_scans(recording, poses, e, 0.2, 3)
    turned = poses.copy()
    turned[1, :3, :3] = [[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]]
    assert good > em.score_held_out_scans(recording, turned, e, 0.2, 3) + 0.5
    assert good > em.score_held_out_scans(recording, poses, 0 * e, 0.2, 3) + 0.5
