"""Scan matching against the true pose of the scan."""

import dataclasses

import numpy as np
import pytest

from stillmap import _core
from stillmap.core import se2
from stillmap.slam.motion_model import MotionPrior
from stillmap.slam.scan_hits import make_scan
from stillmap.slam.scan_matching import is_poor, match_scan, search_pose, widen_match


def prior_at(pose, translation=0.1, rotation=0.1):
    information = np.diag([translation**-2, translation**-2, rotation**-2])
    return MotionPrior(se2.matrix(*pose), information, translation, rotation)


def placed(grid, points, weights, prior, other=None, usual=1.0):
    """The registration of one scan; `usual` of its beams are explained of late."""
    seen = make_scan(points, weights, np.eye(3))
    match = match_scan(grid, seen, prior, usual)
    if len(points) == 0 or not is_poor(match, usual):
        return match
    priors = [prior] if other is None else [prior, other]
    return widen_match(grid, seen, priors, match, usual)


def ones(points):
    return np.ones(len(points), np.float32)


def assert_at(found, truth, metres=0.02, degrees=0.4):
    """The registration is that near the true pose."""
    x, y, theta = se2.parameters(se2.inverse(se2.matrix(*truth)) @ found.T_map_base)
    assert np.hypot(x, y) < metres
    assert abs(theta) < np.radians(degrees)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("least", "most", "std"), [(0.0, 0.1, 0.1), (0.3, 0.6, 0.4)])
def test_finds_a_pose_within_the_prior(room, mapped, scan, seed, least, most, std):
    rng = np.random.default_rng(seed)
    truth = rng.uniform([-0.8, -0.8, -np.pi], [0.8, 0.8, np.pi])
    points = scan(room, truth, seed=seed)
    shift = rng.uniform(least, most, 3) * rng.choice([-1, 1], 3)
    grid, prior = mapped(room, seed=100 * seed), prior_at(truth + shift, std, std)
    found = placed(grid, points, ones(points), prior)
    assert_at(found, truth)
    assert found.explained > 0.7
    assert not found.widened


@pytest.mark.parametrize(
    ("shift", "std"),
    [((0.05, 0.02, 1.4), 0.04), ((0.05, 0.02, -1.4), 0.04), ((-0.4, 0.35, 0.3), 0.03)],
)
def test_a_wrong_pose_is_found_by_a_wider_search(room, mapped, scan, shift, std):
    truth = np.array([0.3, -0.2, 0.7])
    points = scan(room, truth)
    found = placed(mapped(room), points, ones(points), prior_at(truth + shift, std, std))
    assert found.widened
    assert_at(found, truth, 0.03, 0.5)


def test_scan_overrules_odometry(room, mapped, scan):
    truth = np.array([0.3, -0.2, 0.7])
    points = scan(room, truth)
    for shift, is_off in (((0.04, -0.03, 0.03), False), ((0.12, 0.1, 0.0), True)):
        odometry = dataclasses.replace(prior_at(truth + shift, 0.03, 0.03), is_odometry=True)
        found = placed(mapped(room), points, ones(points), odometry)
        assert found.contradicts_odometry == is_off
        assert_at(found, truth)
        guess = dataclasses.replace(odometry, is_odometry=False)
        assert not placed(mapped(room), points, ones(points), guess).contradicts_odometry


@pytest.mark.parametrize("seed", range(4))
def test_search_finds_a_robot_metres_away_at_any_heading(room, mapped, scan, seed):
    rng = np.random.default_rng(20 + seed)
    truth = rng.uniform([-0.8, -0.8, -np.pi], [0.8, 0.8, np.pi])
    points = scan(room, truth, seed=seed)
    wrong = prior_at(truth + rng.uniform(-1, 1, 3) * [2.9, 2.9, np.pi], 3.0, 3.0)
    seen = make_scan(points, ones(points), np.eye(3))
    found = search_pose(mapped(room), seen, wrong, 3.0, np.pi)
    assert_at(found, truth)


def test_unknown_place_keeps_odometry(hall, mapped, scan):
    # nothing in the map explains the scan: no search may drag it anywhere
    points = scan(hall, (0, 0, 0))
    prior = prior_at((200.0, 100.0, 1.0), 0.05, 0.05)
    found = placed(mapped(hall), points, ones(points), prior)
    np.testing.assert_allclose(found.T_map_base, prior.T_map_base, atol=1e-9)
    assert found.explained == 0.0
    assert not found.widened


def test_a_new_place_that_looks_like_a_known_one_is_no_reason_to_leave_odometry(room, mapped, scan):
    # next door: seven beams of ten end as they do in the room that is mapped
    points, rng = scan(room, (0, 0, 0)), np.random.default_rng(3)
    is_other = rng.random(len(points)) < 0.3
    points[is_other] *= rng.uniform(0.5, 0.8, (is_other.sum(), 1)).astype(np.float32)
    next_door = (14.0, 0.0, 0.0)
    prior = dataclasses.replace(prior_at(next_door, 4.2, 0.05), is_odometry=True)
    assert_at(placed(mapped(room), points, ones(points), prior), next_door)
    # where odometry leads into that room, it is the room
    home = dataclasses.replace(prior_at((0.3, 0.2, 0.02), 0.3, 0.05), is_odometry=True)
    assert_at(placed(mapped(room), points, ones(points), home), (0, 0, 0))


def test_zero_weight_equals_absence(hall, mapped, scan):
    grid, truth = mapped(hall), np.array([0.2, 0.1, 0.3])
    points = scan(hall, truth)
    absent = np.random.default_rng(0).random(len(points)) < 0.3
    moved = points.copy()
    moved[absent] += 1.7
    prior = prior_at(truth + np.array([0.06, -0.05, 0.04]))
    with_zeros = placed(grid, moved, (~absent).astype(np.float32), prior)
    without = placed(grid, points[~absent], ones(points[~absent]), prior)
    np.testing.assert_array_equal(with_zeros.T_map_base, without.T_map_base)
    np.testing.assert_array_equal(with_zeros.covariance, without.covariance)
    assert with_zeros.explained == without.explained


def corridor(x_of_walker=None):
    """Two walls along x, 40 m long: nothing but a walker tells where along them one is."""
    walls = [(-20, -1.2, 20, -1.2), (-20, 1.2, 20, 1.2)]
    if x_of_walker is not None:
        x = x_of_walker
        walls += [(x, -0.3, x, 0.3), (x, -0.3, x + 0.3, -0.3), (x, 0.3, x + 0.3, 0.3)]
    return np.array(walls, float)


def test_known_mover_does_not_bias_the_match(scan, put):
    # the walker ahead of the robot has gone on by 0.25 m since the map was made
    grid = _core.OccupancyGrid2D(0.05)
    for k, x in enumerate(np.linspace(-0.6, 0.6, 9)):
        put(grid, scan(corridor(3.0), (x, 0, 0), k), (x, 0, 0))
    there = scan(corridor(3.25), (0, 0, 0), 50)
    walker = np.abs(there[:, 1]) < 0.6
    walker &= there[:, 0] > 0
    assert 5 < walker.sum() < 40
    prior = prior_at((0, 0, 0), 0.3, 0.05)
    e = ones(there)
    pulled = placed(grid, there, e, prior)
    e[walker] = 0.0
    free = placed(grid, there, e, prior)
    assert pulled.T_map_base[0, 2] == pytest.approx(-0.25, abs=0.05)
    assert abs(free.T_map_base[0, 2]) < 0.05
    assert abs(free.T_map_base[1, 2]) < 0.01


@pytest.mark.parametrize("turned", [0.0, 0.6, np.pi / 2])
def test_covariance_is_long_along_a_corridor(scan, put, turned):
    along, across = [np.cos(turned), np.sin(turned)], [-np.sin(turned), np.cos(turned)]
    grid = _core.OccupancyGrid2D(0.05)
    for k, x in enumerate(np.linspace(0.0, 1.5, 40)):
        put(grid, scan(corridor(), (x, 0, 0), k), (x * along[0], x * along[1], turned))
    points = scan(corridor(), (0.7, 0, 0), 9)
    prior = prior_at((0.7 * along[0], 0.7 * along[1], turned), 0.1, 0.1)
    C = placed(grid, points, ones(points), prior).covariance
    np.testing.assert_allclose(C, C.T, atol=1e-15)
    assert np.all(np.linalg.eigvalsh(C) > 0)
    sigma_along = np.sqrt(along @ C[:2, :2] @ along)
    sigma_across = np.sqrt(across @ C[:2, :2] @ across)
    assert sigma_along > 3 * sigma_across
    assert sigma_along == pytest.approx(0.1, rel=0.1)  # the prior's own: the walls say nothing
    assert C[2, 2] < 0.02**2


def test_without_a_beam_or_a_map_the_prior_is_the_answer(hall, mapped, scan):
    nothing = np.zeros((0, 2), np.float32)
    prior = prior_at((1.0, -2.0, 2.5), 0.2, 0.1)
    for grid in (mapped(hall), _core.OccupancyGrid2D(0.05)):
        found = placed(grid, nothing, np.zeros(0, np.float32), prior)
        np.testing.assert_array_equal(found.T_map_base, prior.T_map_base)
        np.testing.assert_allclose(found.covariance, np.linalg.inv(prior.information))
        assert not found.widened
    # nor has an empty map anything to say of a scan
    points = scan(hall, (0, 0, 0))
    found = placed(_core.OccupancyGrid2D(0.05), points, ones(points), prior)
    np.testing.assert_allclose(found.T_map_base, prior.T_map_base, atol=1e-12)
