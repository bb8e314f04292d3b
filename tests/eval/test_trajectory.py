import warnings

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.results.eval.trajectory import (
    align,
    associate_trajectories,
    compute_absolute_errors,
    compute_relative_errors,
    project_flat_trajectories,
)

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    metrics = pytest.importorskip("evo.core.metrics")
    evo_sync = pytest.importorskip("evo.core.sync")
    evo_units = pytest.importorskip("evo.core.units")
    PoseTrajectory3D = pytest.importorskip("evo.core.trajectory").PoseTrajectory3D


def in_space(rng: np.random.Generator, n: int, flat: bool = False) -> np.ndarray:
    """(n, 4, 4) a random walk."""
    T = np.tile(np.eye(4), (n, 1, 1))
    turns = rng.normal(0, 0.2, (n, 3)) * ((0, 0, 1) if flat else (1, 1, 1))
    R, p = Rotation.identity(), np.zeros(3)
    for k in range(n):
        R = R * Rotation.from_rotvec(turns[k])
        p = p + R.apply([rng.uniform(0.05, 0.3), 0, 0])
        T[k, :3, :3], T[k, :3, 3] = R.as_matrix(), p
    return T


def disturbed(rng: np.random.Generator, T: np.ndarray, flat: bool = False) -> np.ndarray:
    """T in another frame, with noise."""
    use = np.array((1, 1, 0, 0, 0, 1) if flat else (1, 1, 1, 1, 1, 1))
    noise = rng.normal(0, 0.05, (len(T), 6)) * use
    frame = np.array([3.0, -2.0, 1.0, 0.4, -0.2, 2.0]) * use
    N = np.tile(np.eye(4), (len(T) + 1, 1, 1))
    all_six = np.vstack([noise, frame])
    N[:, :3, :3] = Rotation.from_rotvec(all_six[:, 3:]).as_matrix()
    N[:, :3, 3] = all_six[:, :3]
    return N[-1] @ T @ N[:-1]


def evo_trajectory(T: np.ndarray, stamps: np.ndarray | None = None):
    times = np.arange(len(T), dtype=float) if stamps is None else stamps
    return PoseTrajectory3D(poses_se3=list(T), timestamps=times)


def assert_stats(ours, metric) -> None:
    wanted = metric.get_all_statistics()
    for name in ("rmse", "mean", "median", "max"):
        assert getattr(ours, name) == pytest.approx(wanted[name], rel=1e-7, abs=1e-7), name


@pytest.mark.parametrize("flat", [False, True])
def test_absolute_errors_agree_with_evo(flat):
    rng = np.random.default_rng(1)
    reference = in_space(rng, 120, flat)
    estimate = disturbed(rng, reference, flat)
    ref, est = evo_trajectory(reference), evo_trajectory(estimate)
    est.align(ref)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((ref, est))
    P, Q = project_flat_trajectories(estimate, reference)
    assert P.shape[-1] == (3 if flat else 4)
    assert_stats(compute_absolute_errors(P, Q), ape)


@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize(("delta", "unit"), [(1, "frames"), (7, "frames"), (1.0, "m"), (2.5, "m")])
def test_relative_errors_agree_with_evo(flat, delta, unit):
    rng = np.random.default_rng(2)
    reference = in_space(rng, 120, flat)
    estimate = disturbed(rng, reference, flat)
    P, Q = project_flat_trajectories(estimate, reference)
    ours = compute_relative_errors(P, Q, delta, unit)
    for relation, stats in (
        (metrics.PoseRelation.translation_part, ours.translation),
        (metrics.PoseRelation.rotation_angle_deg, ours.rotation),
    ):
        rpe = metrics.RPE(
            relation,
            delta=delta,
            delta_unit=evo_units.Unit.meters if unit == "m" else evo_units.Unit.frames,
            rel_delta_tol=0.1,
            all_pairs=True,
            pairs_from_reference=True,
        )
        rpe.process_data((evo_trajectory(reference), evo_trajectory(estimate)))
        assert ours.pairs == len(rpe.error) > 20
        assert_stats(stats, rpe)


@pytest.mark.parametrize("sizes", [(80, 50), (50, 80)])
def test_association_agrees_with_evo(sizes):
    rng = np.random.default_rng(4)
    a, b = (np.sort(rng.uniform(0, 10, n)) for n in sizes)
    T = [np.tile(np.eye(4), (n, 1, 1)) for n in sizes]
    T[0][:, 0, 3], T[1][:, 0, 3] = a, b
    theirs = evo_sync.associate_trajectories(
        evo_trajectory(T[0], a), evo_trajectory(T[1], b), max_diff=0.03
    )
    i, j = associate_trajectories(a, b, 0.03)
    assert 5 < len(i) < 50
    assert a[i].tolist() == theirs[0].timestamps.tolist()
    assert b[j].tolist() == theirs[1].timestamps.tolist()
    with pytest.raises(InputError, match=r"within 0\.02 s"):
        associate_trajectories(a[:1], a[:1] + 1.5, 0.02)


def test_the_same_stamps_belong_together_one_by_one_though_they_repeat():
    stamps = np.array([0.0, 0.0, 1.0, 1.0, 1.0, 2.0])
    i, j = associate_trajectories(stamps, stamps, 0.02)
    np.testing.assert_array_equal(i, np.arange(6))
    np.testing.assert_array_equal(j, np.arange(6))


def test_absolute_error_by_hand():
    # a square whose corners are pushed outwards by 0.1 along x: nothing to align
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]], float)
    truth = se2.matrix(*corners.T, 0.0)
    pushed = se2.matrix(corners[:, 0] * 1.1, corners[:, 1], 0.0)
    stats = compute_absolute_errors(pushed, truth)
    assert (stats.rmse, stats.max) == pytest.approx((0.1, 0.1))


def test_alignment_never_mirrors():
    corners = np.array([[0, 0], [2, 0], [0, 1]], float)
    T = se2.align_points(corners * (1, -1), corners)
    assert np.linalg.det(T[:2, :2]) == pytest.approx(1.0)
    np.testing.assert_allclose(T[:2, :2] @ T[:2, :2].T, np.eye(2), atol=1e-12)


@pytest.mark.parametrize("dimension", [2, 3])
def test_align_recovers_a_frame(dimension):
    rng = np.random.default_rng(5)
    truth = in_space(rng, 30)
    frame = disturbed(rng, np.eye(4)[None])[0]
    if dimension == 2:
        truth = se2.matrix(*rng.normal(0, 3, (3, 30)))
        frame = se2.matrix(4.0, -1.0, 2.5)
    estimated = np.linalg.inv(frame) @ truth
    np.testing.assert_allclose(align(estimated, truth), frame, atol=1e-9)


def test_align_of_a_standing_robot_follows_its_heading():
    truth = np.tile(se2.matrix(2.0, 3.0, 1.0), (5, 1, 1))
    estimated = np.tile(np.eye(3), (5, 1, 1))
    np.testing.assert_allclose(align(estimated, truth), truth[0], atol=1e-12)


def test_align_trusts_a_long_path_more_than_headings():
    x = np.linspace(-50, 50, 101)
    truth, skewed = se2.matrix(x, 0.0, 0.0), se2.matrix(x, 0.0, 0.3)
    assert abs(se2.parameters(align(skewed, truth))[2]) < 1e-3


def test_relative_errors_by_hand():
    x = np.arange(6.0)
    truth = se2.matrix(x, 0.0, 0.0)
    scaled = se2.matrix(1.1 * x, 0.0, 0.01 * x)
    errors = compute_relative_errors(scaled, truth, 2, "frames")
    assert errors.pairs == 4
    assert errors.rotation.max == pytest.approx(np.degrees(0.02))
    assert errors.rotation.rmse == pytest.approx(np.degrees(0.02))
    assert compute_relative_errors(scaled, truth, 2.0, "m") == errors


def test_a_standing_robot_has_no_pairs_a_metre_apart():
    still = np.tile(np.eye(3), (5, 1, 1))
    errors = compute_relative_errors(still, still, 1.0, "m")
    assert errors.pairs == 0
    assert errors.to_dict()["rotation"]["rmse"] is None
    spatial = np.tile(np.eye(4), (3, 1, 1))
    assert compute_relative_errors(spatial, spatial, 5, "frames").pairs == 0


@pytest.mark.parametrize(("delta", "unit"), [(0, "frames"), (1.5, "frames"), (0.0, "m")])
def test_impossible_steps_are_refused(delta, unit):
    with pytest.raises(InputError, match="a step of"):
        compute_relative_errors(np.eye(3)[None], np.eye(3)[None], delta, unit)
