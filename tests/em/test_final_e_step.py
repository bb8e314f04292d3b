"""The final E-step: view-dependent surface is no passer-by."""

from dataclasses import replace

import numpy as np
import pytest
from made_up import ANGLES, Ball
from recordings import of_one_sensor

from stillmap import _core, em
from stillmap.core import se2

POST, RADIUS, WALL = (5.0, 3.0), 0.15, 5.0
SCANS, SECONDS = 80, 0.5


def seen(at, hit_mask):
    """A sensor at x = `at` in each scan, before a wall and a post that it hits or misses.

    Returns the recording, its poses, and which beams end on the post (T, 181).
    """
    directions = np.column_stack([-np.sin(ANGLES), np.cos(ANGLES)])  # a half circle to the left
    far = np.where(directions[:, 1] > 0.5, WALL / np.maximum(directions[:, 1], 0.5), np.nan)
    post = Ball(*POST, 0, 0, RADIUS)
    near = np.array([post.ranges(np.array([x, 0.0]), directions) for x in at])
    on = np.isfinite(near) & np.asarray(hit_mask)[:, None]
    ranges = np.where(on, near, far)
    T = se2.matrix(at, 0.0, 0.0)
    points = ranges[..., None] * directions
    recording = of_one_sensor(
        np.round(1e9 * SECONDS * np.arange(len(at))).astype(np.int64),
        len(ANGLES) * np.arange(len(at) + 1),
        points.reshape(-1, 2).astype(np.float32),
        np.isfinite(ranges).ravel(),
    )
    return recording, T, on.ravel()


def labels(at, hit_mask):
    """(M,) p_static in the loop and in the last E-step, and which beams end on the post."""
    recording, T, on = seen(at, hit_mask)
    loop = em.e_step(recording, T, _core.OccupancyGrid2D(0.05), "stillmap", em.EmOptions(), 1)
    last, histories = em.final_e_step(recording, T, 0.05, em.EmOptions())
    assert on.sum() > 5
    assert histories is not None
    return loop.p_static, last.p_static, on


def by_views(at, turn=0.25):
    """Hits from half of the views, in sectors of the viewing angle."""
    angle = np.arctan2(POST[1], POST[0] - np.asarray(at))
    return np.floor(angle / turn) % 2 == 1


ROUNDS = 5.0 + 4.0 * np.sin(np.linspace(0, 6 * np.pi, SCANS))


@pytest.mark.parametrize("turn", [0.25, 0.4, 0.6])
def test_view_dependent_surface_is_static(turn):
    loop, last, on = labels(ROUNDS, by_views(ROUNDS, turn))
    assert np.median(last[on]) > 0.9
    assert np.median(loop[on]) < 0.1
    wall = ~on & np.isfinite(last)
    assert np.quantile(last[wall], 0.05) > 0.9


STANDS = np.full(SCANS, 2.0)
PASSES = (np.arange(SCANS) >= 30) & (np.arange(SCANS) < 34)
ALTERNATES = np.random.default_rng(1).random(SCANS) < 0.5


@pytest.mark.parametrize(
    ("at", "hit_mask"), [(STANDS, PASSES), (ROUNDS, PASSES), (STANDS, ALTERNATES)]
)
def test_passers_by_and_what_alternates_before_a_standing_sensor_are_dynamic(at, hit_mask):
    loop, last, on = labels(at, hit_mask)
    assert np.median(loop[on]) < 0.1
    assert np.median(last[on]) < 0.1


APART = 1.2  # m, of two lasers
# for seconds, half of the time
COMES_AND_GOES = np.logical_xor.accumulate(np.random.default_rng(2).random(4 * SCANS) < 0.15)


def test_two_lasers_do_not_turn_the_view():
    """They scan by turns, three scans to a time bin: one or two of the second laser."""
    at = np.full(3 * len(COMES_AND_GOES), 2.0)
    second = np.arange(len(at)) % 2 == 1
    recording, _, on = seen(at + APART * second, np.repeat(COMES_AND_GOES, 3))
    recording = replace(
        recording,
        T_base_sensor=se2.matrix([0.0, APART], 0.0, 0.0),
        sensor=second.astype(np.int32),
        stamp_ns=recording.stamp_ns // 3,
    )
    T = se2.matrix(at, 0.0, 0.0)
    last, _ = em.final_e_step(recording, T, 0.05, em.EmOptions())
    assert np.median(last.p_static[on]) < 0.1
