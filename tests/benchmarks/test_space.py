"""What labels in space are scored with, and that all methods get the same beams in turn."""

import os
import sys
from pathlib import Path

import numpy as np
import pytest
import space
import space_cases
import space_methods
from space_cases import Case, Known
from space_scores import accuracies, scores

from stillmap.sim.truth import Truth

NAN = float("nan")


def test_accuracies_by_hand() -> None:
    static = np.array([True, True, True, True, False, False])
    p_static = np.array([0.9, 0.5, NAN, 0.1, 0.1, 0.9])
    # 3 of 4 static ones stay, 1 of 2 dynamic ones goes: 2 * 75 * 50 / 125
    assert accuracies(p_static, static) == {"sa": 75.0, "da": 50.0, "ha": 60.0}
    assert accuracies(1.0 - static, static) == {"sa": 0.0, "da": 0.0, "ha": 0.0}
    nobody = accuracies(p_static[:4], static[:4])
    assert nobody["sa"] == 75.0
    assert np.isnan([nobody["da"], nobody["ha"]]).all()


def test_accuracies_of_a_published_row() -> None:
    # BeautyMap on sequence 00 of KITTI: SA 96.9529, DA 98.3382, HA 97.6407
    static = np.repeat([True, False], 1_000_000)
    p_static = np.concatenate([np.arange(1_000_000) < 969_529, np.arange(1_000_000) >= 983_382])
    assert accuracies(p_static.astype(float), static)["ha"] == pytest.approx(97.6407, abs=1e-4)


def test_scores_by_kind_leave_out_what_nobody_knows() -> None:
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


def test_every_round_has_every_method_once_and_begins_with_another() -> None:
    turns = list(space.in_turns(["a", "b", "c"], 4))
    rounds = [turns[k : k + 3] for k in range(0, 12, 3)]
    assert [one[0] for one in rounds] == ["a", "b", "c", "a"]
    assert all(sorted(one) == ["a", "b", "c"] for one in rounds)


def test_costs_are_medians_of_rounds() -> None:
    costs = [
        {"seconds": s, "label_seconds": s, "cpu": 2 * s, "peak": 9.0, "label_peak": 8.0, "n": 1}
        for s in (3.0, 1.0, 2.0)
    ]
    assert space.typical(costs) == {**costs[2]}


def test_methods_of_others_need_their_python() -> None:
    assert space.chosen_methods(None, False, True) == [*space_methods.OURS, space.ESTIMATED]
    assert set(space_methods.PEERS) < set(space.chosen_methods(None, True, False))
    with pytest.raises(SystemExit, match="OctoMap"):
        space.chosen_methods(["OctoMap"], False, False)


def test_labels_of_files(tmp_path: Path) -> None:
    instance = 7 << 16
    np.array([252 | instance, 9], np.uint32).tofile(tmp_path / "000000.label")
    np.array([0, 252], np.uint32).tofile(tmp_path / "000001.label")
    known = space_cases.labelled(tmp_path)
    assert known.static.tolist() == [False, True, False, False]
    assert known.scored.tolist() == [True, True, False, True]
    assert [known.kinds[k] for k in known.kind[known.scored]] == ["moving", "static", "moving"]


def test_who_is_met_at_rest_only() -> None:
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


_PRETENDED = """
import numpy as np

class dufomap:
    def __init__(self, resolution, d_s, d_p, num_threads):
        assert (resolution, d_s, d_p, num_threads) == (0.1, 0.2, 2, 2)
        self.seen = []
    def run(self, points, T, cloud_transform):
        assert points.dtype == np.float32 and T.shape == (4, 4)
        self.seen.append(points)
    def oncePropagateCluster(self, if_propagate, if_cluster):
        assert if_propagate and not if_cluster
    def segment(self, points, T, cloud_transform):
        assert any(np.array_equal(points, one) for one in self.seen)
        return (points[:, 0] > 0).astype(int)
"""


def test_ours_and_others_label_the_same_beams(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "dufomap.py").write_text(_PRETENDED)
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    changes = {"lidar": {"channels": 16, "columns": 90}, "robot": {"scans": 4}}
    work = tmp_path / "case"
    about = space_cases.prepare(Case("street, 16", changes, 0), work)
    known = space_cases.known_of_given(work)
    points = np.fromfile(work / "points.bin", np.float32).reshape(-1, 3)
    assert len(points) == len(known.static) == about["given"] < about["beams"]
    far = np.linalg.norm(points, axis=1)
    assert (far >= space_cases.NEAREST).all()
    assert (known.scored == (far < space_cases.FARTHEST)).all()
    assert 0 < known.scored.sum() < len(points)

    theirs = space_methods.of_peer(work, "DUFOMap", sys.executable, 2, tmp_path / "d.npy")
    assert np.load(tmp_path / "d.npy").tolist() == (points[:, 0] <= 0).astype(float).tolist()
    ours = space_methods.of_ours(work, "stillmap", (), 1, tmp_path / "s.npy")
    assert np.load(tmp_path / "s.npy").shape == (len(points),)
    assert set(theirs) == set(ours) - {"iterations"}
    assert 0.0 < ours["label_seconds"] <= ours["seconds"]

    with pytest.raises(RuntimeError, match="octomap"):
        space_methods.of_peer(work, "OctoMap", sys.executable, 2, tmp_path / "o.npy")
