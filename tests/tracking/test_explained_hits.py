"""What a fast mover explains is dynamic, and what stands beside its way is not."""

import dataclasses

import numpy as np
from recordings import of_one_sensor

from stillmap.mapping.labelled_recording import LabelledRecording
from stillmap.tracking.explained_hits import PLACE, compute_log_ratio, explain_hits, find_mover_hits
from stillmap.tracking.mover_path import MoverPath

SECONDS = np.arange(0.0, 4.0, 0.1)
WAY = np.column_stack([5.0 * SECONDS, np.zeros(len(SECONDS))])
CAR = np.array([1.0, 0.0])  # where a beam ends on it at each time, from its center
POST = np.array([10.0, 1.0])  # right beside the way


def recorded():
    """Two beams per scan: one on the car that moves along x with 5 m/s, one on a post."""
    n = len(SECONDS)
    points = np.stack([WAY + CAR, np.tile(POST, (n, 1))], axis=1).reshape(-1, 2)
    stamp_ns, offset = (SECONDS * 1e9).astype(np.int64), np.arange(n + 1) * 2
    return of_one_sensor(stamp_ns, offset, points.astype(np.float32), np.ones(2 * n, bool))


def path():
    velocity = np.tile([5.0, 0.0], (len(SECONDS), 1))
    return MoverPath(SECONDS, WAY, velocity, length=4.0, width=2.0)


def explained(p_mover, paths, is_vehicle=True):
    recording = recorded()
    before = np.full(recording.n_beams, 0.9, np.float32)
    poses = np.tile(np.eye(3), (len(SECONDS), 1, 1))
    on_movers = find_mover_hits(recording, poses, SECONDS, paths, np.array(p_mover))
    vehicles = np.full(len(paths), is_vehicle)
    after = explain_hits(LabelledRecording(recording, poses, before, PLACE), on_movers, vehicles)
    assert (before == np.float32(0.9)).all()
    return after.reshape(-1, 2).T


def test_static_hits_on_a_car_become_dynamic_and_the_post_beside_it_stays():
    car, post = explained([1.0], [path()])
    assert car.max() < 0.4
    assert np.median(car) < 0.35
    assert post.min() > 0.85


def test_as_far_as_the_path_is_one_of_a_mover():
    (whole, _), (car, _) = explained([1.0], [path()]), explained([0.4], [path()])
    assert (whole < car - 0.1).all()
    assert (car < 0.8).all()
    np.testing.assert_array_equal(explained([], []), np.float32(0.9))  # without a path


def test_few_hits_in_a_place_follow_what_holds_elsewhere_on_the_road():
    """A look at a place says little by itself; where cars explain all places, they explain it."""
    (car, _), (walker, _) = explained([1.0], [path()]), explained([1.0], [path()], False)
    alone = 1.0 / (1.0 + np.exp(-compute_log_ratio(np.array([1.0]), np.array([0.0]))))
    np.testing.assert_allclose(walker.max(), 0.9 * alone[0], rtol=1e-5)
    assert car.max() < walker.min() - 0.05


def test_what_is_beside_a_walker_is_not_on_him():
    xy = np.tile([10.0, 0.7], (len(SECONDS), 1))
    walker = MoverPath(SECONDS, xy, np.zeros_like(xy), length=0.5, width=0.5, is_round=True)
    poses, recording = np.tile(np.eye(3), (len(SECONDS), 1, 1)), recorded()
    for offset, n_hits in (((0.0, 0.0), len(SECONDS)), ((0.24, 0.0), 0)):
        moved = dataclasses.replace(walker, xy=xy + offset)
        found = find_mover_hits(recording, poses, SECONDS, [moved], np.ones(1))
        assert np.count_nonzero(found.beam % 2) == n_hits  # on the post 0.3 m away, or 0.38 m
