import math

import numpy as np
import pytest
from cases import Case
from common import scores
from prepared import counts, prepare, without_people

from stillmap import em


@pytest.fixture(scope="module")
def run():
    changes = {"robot": {"scans": 150}, "crowd": {"people": 25}}
    return prepare(Case("office", "", "office", changes), 3)


def test_true_labels_at_true_poses_score_full_marks(run):
    recording, truth = run.simulation.recording, run.simulation.truth
    labels = truth.static.astype(np.float32)
    grid = counts(recording, recording.points, recording.hit, labels, truth.T_world_base)
    found = scores(labels, truth.T_world_base, em.make_occupancy_map(grid), run)
    assert found["ap"] == found["f1"] == found["walls_at_best"] == 1.0
    assert found["brier"] == found["ece"] == found["ghosts"] == 0.0
    assert found["ate"] == pytest.approx(0.0, abs=1e-9)
    assert 0.7 < found["walls"] < 1.0  # people hide some for as long as this takes
    assert found["called_dynamic"] == found["dynamic"] > 0.01


def test_what_ended_on_doors_is_left_out_of_the_scores_without_them(run):
    recording, truth = run.simulation.recording, run.simulation.truth
    kinds = np.array([*truth.scene["mover_kinds"], "none"])[truth.mover]
    door = kinds == "door"
    assert np.count_nonzero(door) > 100
    doors_unsure = np.where(door, 0.9, truth.static).astype(np.float32)
    people_unsure = np.where(kinds == "person", 0.9, truth.static).astype(np.float32)
    grid = counts(recording, recording.points, recording.hit, people_unsure, truth.T_world_base)
    scored = [
        scores(labels, truth.T_world_base, em.make_occupancy_map(grid), run)
        for labels in (doors_unsure, people_unsure)
    ]
    assert scored[0]["f1_no_doors"] == scored[0]["ap_no_doors"] == 1.0
    assert scored[0]["brier_no_doors"] == scored[0]["ece_no_doors"] == 0.0
    assert math.isnan(scored[0]["ece_unsure_no_doors"])  # no beam left to be unsure of
    assert min(scored[0]["brier"], scored[0]["ece"], scored[0]["ece_unsure"]) > 0.0
    for key in ("brier", "ece"):
        assert scored[1][f"{key}_no_doors"] > scored[1][key] > 0.0  # the same, of fewer beams
    assert scored[1]["ece_unsure_no_doors"] == scored[1]["ece_unsure"] == pytest.approx(0.9)


def test_without_people_only_what_they_hid_differs(run):
    sim = run.simulation
    points, hit, static = without_people(sim, np.random.default_rng(0))
    kinds = np.array([*sim.truth.scene["mover_kinds"], "none"])[sim.truth.mover]
    both = hit & sim.recording.hit
    off = np.hypot(*(points - sim.recording.points).T)
    undisturbed = both & (kinds != "person")
    noise = sim.scene.laser.range_noise
    assert off[undisturbed].max() < 10 * noise
    assert np.mean(off[both & (kinds == "person")] > 10 * noise) > 0.9
    # doors are where they were
    assert np.mean(static[undisturbed & (kinds == "door")]) < 0.01
    assert np.mean(static[undisturbed & (kinds == "none")]) > 0.999
