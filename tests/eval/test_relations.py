import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from stillmap.results.eval.readers import read_odometry, read_planar_trajectory, read_relations
from stillmap.results.eval.trajectory import RelationErrors, compute_relation_errors


def relation(t1: float, t2: float, x: float, y: float, yaw: float) -> list[float]:
    return [t1, t2, x, y, 0.0, 0.0, 0.0, yaw]


def random_walk(rng: np.random.Generator, n: int) -> np.ndarray:
    heading = rng.normal(0, 0.3, n).cumsum()
    step = rng.uniform(0, 0.4, n)
    return np.column_stack(
        [
            976052857.0 + rng.uniform(0.05, 0.6, n).cumsum(),
            np.cumsum(step * np.cos(heading)),
            np.cumsum(step * np.sin(heading)),
            (heading + np.pi) % (2 * np.pi) - np.pi,
        ]
    )


def test_one_relation_by_hand():
    # from (1, 2) heading north to (1, 5) heading west: 3 m ahead, a quarter turn to the left
    trajectory = np.array([[0.0, 1.0, 2.0, math.pi / 2], [1.0, 1.0, 5.0, math.pi]])
    wanted = np.array([relation(0, 1, 2.6, 0.3, math.pi / 2 - 0.1)])
    errors = compute_relation_errors(trajectory, wanted)
    assert errors.used == 1
    assert errors.translation.mean == pytest.approx(0.5)  # 0.4 ahead, 0.3 aside
    assert errors.translation.squared_mean == pytest.approx(0.25)
    assert errors.rotation.mean == pytest.approx(math.degrees(0.1))
    assert errors.translation.std == 0.0
    # angles the short way round
    trajectory = np.array([[0.0, 0, 0, 0], [1.0, 0, 0, -math.pi + 0.01]])
    errors = compute_relation_errors(trajectory, np.array([relation(0, 1, 0, 0, math.pi - 0.01)]))
    assert errors.rotation.mean == pytest.approx(math.degrees(0.02))


def test_statistics_by_hand():
    trajectory = np.array([[float(k), float(k), 0.0, 0.0] for k in range(5)])
    wanted = np.array([relation(0, k, k - off, 0, 0) for k, off in ((1, 0.1), (2, 0.2), (3, 0.6))])
    spread = compute_relation_errors(trajectory, wanted).translation
    assert spread.mean == pytest.approx(0.3)
    assert spread.median == pytest.approx(0.2)
    assert spread.max == pytest.approx(0.6)
    assert spread.std == pytest.approx(math.sqrt((0.04 + 0.01 + 0.09) / 2))
    assert spread.squared_mean == pytest.approx((0.01 + 0.04 + 0.36) / 3)


def test_composed_error_is_seen_from_the_reference():
    # the difference of components, (1, 0), is (0, -1) in a frame that heads north: the same length
    trajectory = np.array([[0.0, 0, 0, 0], [1.0, 3.0, 0, math.pi / 2]])
    wanted = np.array([relation(0, 1, 2.0, 0, math.pi / 2 - 0.1)])
    plain, composed = (
        compute_relation_errors(trajectory, wanted, compose=c) for c in (False, True)
    )
    assert composed.translation.mean == pytest.approx(1.0)
    assert composed.translation.mean == pytest.approx(plain.translation.mean)
    assert composed.rotation.mean == pytest.approx(math.degrees(0.1))
    assert composed.rotation.mean == pytest.approx(plain.rotation.mean)


def test_nearest_pose_within_the_limit_stands_for_a_time():
    trajectory = np.array([[0.0, 0, 0, 0], [1.0, 1, 0, 0], [2.0, 2, 0, 0]])
    wanted = np.array([relation(0.05, 1.9, 2, 0, 0), relation(0, 1.5, 1, 0, 0)])
    errors = compute_relation_errors(trajectory, wanted, max_dt=0.101)
    assert (errors.relations, errors.used, errors.stamps) == (2, 1, 4)
    assert errors.translation.max == 0.0
    assert compute_relation_errors(trajectory, wanted, max_dt=0.5).used == 2


def test_odometry_reaches_times_without_a_pose():
    # the map is turned by 90 degrees against odometry: the step must be turned with it
    trajectory = np.array([[0.0, 0, 0, math.pi / 2], [10.0, 0, 9, math.pi / 2]])
    odometry = np.array([[float(k), float(k), 5.0, 0.0] for k in range(11)])
    wanted = np.array([relation(0, 3, 3, 0, 0), relation(3, 8, 4.0, 0, 0)])
    errors = compute_relation_errors(trajectory, wanted, odometry)
    assert (errors.used, errors.stamps_by_odometry) == (2, 2)
    # 3 s: 3 m after the first pose; 8 s: 2 m before the last, at 7 m
    assert errors.translation.max == pytest.approx(0.0, abs=1e-12)


def test_no_relation_used_gives_no_numbers():
    errors = compute_relation_errors(np.zeros((1, 4)), np.array([relation(5, 6, 1, 0, 0)]))
    assert errors.used == 0
    assert errors.to_dict()["translation"]["mean"] is None


def test_global_motion_changes_nothing():
    rng = np.random.default_rng(3)
    trajectory = random_walk(rng, 50)
    c, s = math.cos(2.0), math.sin(2.0)
    moved = trajectory.copy()
    moved[:, 1] = 7 + c * trajectory[:, 1] - s * trajectory[:, 2]
    moved[:, 2] = -3 + s * trajectory[:, 1] + c * trajectory[:, 2]
    moved[:, 3] += 2.0
    t = trajectory[:, 0]
    wanted = np.array([relation(t[k], t[k + 7], 1, 0, 0) for k in range(40)])
    a, b = compute_relation_errors(trajectory, wanted), compute_relation_errors(moved, wanted)
    assert b.translation.mean == pytest.approx(a.translation.mean)
    assert b.rotation.max == pytest.approx(a.rotation.max)


@pytest.fixture(scope="session")
def judge(shared_data):
    """The stand-alone evaluator beside the recordings, as a function of its arguments."""
    script = shared_data.parent / "eval" / "eval_relations.py"
    if not script.is_file():
        pytest.skip("no eval_relations.py beside the real recordings")

    def run(*args: object) -> dict:
        command = [sys.executable, str(script), *(str(arg) for arg in args), "--json"]
        return json.loads(subprocess.run(command, check=True, capture_output=True).stdout)

    return run


def assert_same(ours: RelationErrors, theirs: dict) -> None:
    assert (ours.relations, ours.used) == (theirs["relations"], theirs["used"])
    assert ours.stamps == theirs["stamps"]
    assert ours.stamps_by_odometry == theirs["stamps_by_odometry"]
    pairs = [
        ((ours.translation.mean, ours.translation.std), theirs["trans_abs"]),
        ((ours.translation.squared_mean, ours.translation.squared_std), theirs["trans_sqr"]),
        ((ours.rotation.mean, ours.rotation.std), theirs["rot_abs_deg"]),
        ((ours.rotation.squared_mean, ours.rotation.squared_std), theirs["rot_sqr_deg2"]),
        ((ours.translation.median, ours.translation.max, ours.rotation.max),
         (theirs["trans_median"], theirs["trans_max"], theirs["rot_max_deg"])),
    ]  # fmt: skip
    for got, wanted in pairs:
        assert got == pytest.approx(tuple(wanted), rel=1e-9, abs=1e-9)


def written(path: Path, rows: np.ndarray) -> Path:
    np.savetxt(path, rows, fmt="%.9f")
    return path


@pytest.mark.parametrize("compose", [False, True])
@pytest.mark.parametrize("with_odometry", [False, True])
def test_random_data_against_the_stand_alone_evaluator(tmp_path, judge, compose, with_odometry):
    rng = np.random.default_rng(11)
    odometry = random_walk(rng, 400)
    odometry[:, 0] = odometry[:, 0].round(2)  # rounded stamps, some of them equal
    trajectory = odometry[::3] + rng.normal(0, (0, 0.1, 0.1, 0.05), (134, 4))
    ends = rng.choice(odometry[:, 0], (150, 2)) + rng.normal(0, 0.05, (150, 2))
    motion = rng.normal(0, 1, (150, 6))
    t, r, o = (
        written(tmp_path / name, rows)
        for name, rows in (
            ("t.txt", rng.permutation(trajectory)),
            ("r.txt", np.hstack([ends, motion])),
            ("o.txt", odometry),
        )
    )
    flags = (["--odom", o] if with_odometry else []) + (["--compose"] if compose else [])
    theirs = judge(t, r, *flags)
    assert theirs["used"] > 0
    assert (theirs["used"] == 150) == with_odometry
    odom = read_odometry(o) if with_odometry else None
    ours = compute_relation_errors(
        read_planar_trajectory(t), read_relations(r), odom, compose=compose
    )
    assert_same(ours, theirs)
