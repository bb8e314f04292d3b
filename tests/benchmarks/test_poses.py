import math

import numpy as np
import pytest
from cases import Case, chosen
from common import options_of
from poses import (
    ABLATION,
    CASES,
    COLUMNS,
    DEFAULTS,
    NO_ODOMETRY,
    Job,
    Variant,
    loop_scores,
    pose_scores,
    report,
    rows_of,
    variants,
)

from stillmap.core import se2
from stillmap.slam import LoopClosure


def there_and_back(T: int) -> np.ndarray:
    """A metre per scan along x, and back."""
    x = np.concatenate([np.arange(T), np.arange(T)[::-1]]).astype(float)
    return se2.matrix(x, np.zeros(2 * T), np.zeros(2 * T))


def loop(
    earlier: int, later: int, T: np.ndarray, refused: str = "", sigma: float = 0.02
) -> LoopClosure:
    return LoopClosure(earlier, later, T, sigma**2 * np.eye(3), 0.9, refused)


def test_cases_and_variants_are_there() -> None:
    assert len(chosen(CASES)) > len(CASES)
    whole, *parts = (options_of("stillmap", variant.settings) for variant in ABLATION)
    assert whole == options_of("stillmap", [])
    assert all(part != whole for part in parts)
    assert len({variant.name for variant in ABLATION}) == len(ABLATION)
    assert variants(False, False) == (DEFAULTS,)
    assert variants(True, True) == (*ABLATION, NO_ODOMETRY)


def test_a_place_seen_again_is_told_from_one_seen_just_before() -> None:
    truth, stamp_ns = there_and_back(60), 10**18 + np.arange(120) * 10**9
    poses = truth.copy()
    poses[60:, 0, 2] += 0.3  # the way back lies off
    scores = pose_scores(stamp_ns, poses, truth)
    # of the pairs, those around the turn are off but not seen again
    assert scores["again"] == pytest.approx(0.3)
    assert 0.1 < scores["translation"] < 0.2
    assert scores["translation_max"] == pytest.approx(0.3)
    assert scores["rotation_max"] < 1e-9
    assert scores["drift"] == pytest.approx(100 * 0.3 / 118)
    assert scores["ate"] == pytest.approx(0.15)
    ahead = se2.matrix(np.arange(30.0), np.zeros(30), np.zeros(30))
    assert math.isnan(pose_scores(stamp_ns[:30], ahead, ahead)["again"])


def test_a_loop_is_false_by_its_displacement_and_only_when_accepted() -> None:
    truth = se2.matrix(1.0, 2.0, 0.7) @ there_and_back(60)
    true = se2.inverse(truth[10]) @ truth[109]
    loops = [
        loop(10, 109, true),
        loop(10, 109, true @ se2.matrix(0.3, 0.39, 0.0)),
        loop(10, 109, true @ se2.matrix(0.3, 0.41, 0.0)),
        loop(10, 109, true @ se2.matrix(0.0, 0.0, np.radians(-5.1))),
        loop(10, 109, true @ se2.matrix(9.0, 0.0, 0.0), "other loops disagree"),
        loop(10, 109, true @ se2.matrix(0.9, 0.0, 0.0), sigma=0.3),  # that is what it says
        loop(10, 109, true @ se2.matrix(1.3, 0.0, 0.0), sigma=0.3),
    ]
    assert loop_scores(loops, truth) == {"accepted": 6, "refused": 1, "false": 3}


def test_runs_are_mapped_in_every_way_and_shown() -> None:
    case = Case("short", "trajectory", "hall", {"robot": {"scans": 60}})
    once = ("em.max_iterations=1",)
    some = (DEFAULTS, NO_ODOMETRY, Variant("coarse", ("slam.resolution=0.2",)))
    rows = rows_of(Job(case, 0, some, once))
    assert [row["variant"] for row in rows] == ["defaults", "no odometry", "coarse"]
    for row in rows:
        assert {column.key for column in COLUMNS} <= set(row)
        assert 0.0 < row["translation"] < 0.2
        assert 0.0 < row["m_step"] < row["cpu"]
        assert row["peak"] > 50
    assert len({row["translation"] for row in rows}) == 3
    text = report([{**row, "case": name} for name in ("a", "b") for row in rows])
    assert text.count("no odometry") == 3
    assert text.count("all cases") == 1
    assert report(rows[:1]).count("defaults") == 1
