"""What labels in space are scored with, and that all methods get the same beams in turn."""

import numpy as np
import pytest
import space_cases
from space_cases import Known
from space_scores import accuracies, scores

from stillmap.sim.truth import Truth

NAN = float("nan")


def test_accuracies_by_hand():
    static = np.array([True, True, True, True, False, False])
    p_static = np.array([0.9, 0.5, NAN, 0.1, 0.1, 0.9])
    # 3 of 4 static ones stay, 1 of 2 dynamic ones goes: 2 * 75 * 50 / 125
    assert accuracies(p_static, static) == {"sa": 75.0, "da": 50.0, "ha": 60.0}
    assert accuracies(1.0 - static, static) == {"sa": 0.0, "da": 0.0, "ha": 0.0}
    nobody = accuracies(p_static[:4], static[:4])
    assert nobody["sa"] == 75.0
    assert np.isnan([nobody["da"], nobody["ha"]]).all()


def test_accuracies_of_a_published_row():
    # BeautyMap on sequence 00 of KITTI: SA 96.9529, DA 98.3382, HA 97.6407
    static = np.repeat([True, False], 1_000_000)
    p_static = np.concatenate([np.arange(1_000_000) < 969_529, np.arange(1_000_000) >= 983_382])
    assert accuracies(p_static.astype(float), static)["ha"] == pytest.approx(97.6407, abs=1e-4)


def test_scores_by_kind_leave_out_what_nobody_knows():
    known = Known(
        static=np.array([True, True, False, False, False, False]),
        kind=np.array([2, 2, 0, 0, 1, 2], np.int16),
        scored=np.array([True, True, True, True, True, False]),
        kinds=["car", "door", "static"],
        rested=np.array([False, False, False, True, False, True]),
    )
    row = scores(np.array([0.9, 0.8, 0.1, 0.2, 0.7, 0.9]), known, certain=False)
    assert row["sa"] == 100.0
    assert row["da"] == pytest.approx(200.0 / 3.0)
    assert (row["recall_car"], row["recall_door"]) == (100.0, 0.0)
    assert row["ha_without"] == 100.0
    assert row["ha_moved"] == pytest.approx(200.0 / 3.0)  # one of two is found
    assert row["rested"] == pytest.approx(100.0 / 3.0)
    assert row["brier"] == pytest.approx((0.01 + 0.04 + 0.01 + 0.04 + 0.49) / 5.0)
    assert (row["n_static"], row["n_dynamic"], row["n_car"]) == (2.0, 3.0, 2.0)
    assert "recall_static" not in row
    assert "ap" not in scores(np.ones(6), known, certain=True)


def test_labels_of_files(tmp_path):
    instance = 7 << 16
    np.array([252 | instance, 9], np.uint32).tofile(tmp_path / "000000.label")
    np.array([0, 252], np.uint32).tofile(tmp_path / "000001.label")
    known = space_cases.labelled(tmp_path)
    assert known.static.tolist() == [False, True, False, False]
    assert known.scored.tolist() == [True, True, False, True]
    assert [known.kinds[k] for k in known.kind[known.scored]] == ["moving", "static", "moving"]


def test_who_is_met_at_rest_only():
    movers = np.zeros((4, 4, 3))
    movers[:, 0, 0] = [0.0, 3.0, 3.1, 3.2]  # met once he stands
    movers[:, 1, 0] = [0.0, 0.0, 0.0, 5.0]  # met before and after
    movers[:, 2, 2] = [0.0, 0.0, 0.5, 0.5]  # a door
    movers[1:, 3] = np.nan  # taken away
    truth = Truth(
        static=np.array([True] + [False] * 7),
        mover=np.array([-1, 1, 3, 0, 2, 0, 2, 1], np.int32),
        T_world_base=np.tile(np.eye(4), (4, 1, 1)),
        walls=np.empty((0, 4)),
        movers=movers,
        scene={"mover_kinds": ["car", "car", "door", "thing"]},
    )
    rested = space_cases.met_at_rest(truth, np.array([0, 3, 5, 7, 8]))
    assert np.flatnonzero(rested).tolist() == [3, 5]
