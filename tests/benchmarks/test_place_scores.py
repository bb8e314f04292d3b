"""Scores of places: a perfect one is perfect, and each error shows where it belongs."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from made_up_place import write_place
from place_scores import score_place
from place_truth import load_session_truth

from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.sim import scene_by_name
from stillmap.sim.sessions import plan_sessions, write_sessions

# whole simulations are scored
pytestmark = pytest.mark.slow

QUICK = {"laser": {"beams": 180}, "robot": {"scans": 300}, "crowd": {"people": 2}}


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    """Three sessions of a corridor with six rooms."""
    folder = tmp_path_factory.mktemp("sessions") / "days"
    plan = plan_sessions(scene_by_name("lookalike-1", QUICK), 3, 5)
    write_sessions([plan], folder)
    return load_session_truth(folder)


@pytest.fixture(scope="module")
def perfect(truth, tmp_path_factory):
    folder = tmp_path_factory.mktemp("place") / "perfect"
    write_place(folder, truth)
    return folder


@pytest.fixture
def place(perfect, tmp_path):
    """A perfect one, to be spoilt."""
    return Path(shutil.copytree(perfect, tmp_path / "place"))


def test_a_perfect_place_is_perfect(perfect, truth):
    scores = score_place(perfect, truth.folder)
    assert (scores.right, scores.wrong, scores.refused) == (3, 0, 0)
    for one in scores.sessions:
        assert max(one.max_distance, one.max_seam, one.start_translation) < 1e-6
        assert one.rotation < 1e-4
        assert one.overlap > 0.3
    changes = scores.changes
    assert changes.source == "boxes"
    assert changes.cells > 100
    assert changes.events > 5
    assert changes.f1 > 0.98
    assert changes.events_found == changes.events
    assert changes.dates_right == 1.0
    (own,) = scores.maps
    assert own.walls_kept == 1.0
    assert own.ghost_cells == 0
    assert own.wall_cells > 500


@pytest.mark.parametrize(
    ("shift", "verdict"),
    [
        ((0.03, 0.0, 0.0), "right"),
        ((0.0, 0.2, 0.0), "coarse"),
        ((0.0, 0.0, 0.02), "coarse"),
        ((3.0, 0.0, 0.0), "wrong"),
        ((0.0, 0.0, np.pi), "wrong"),
    ],
)
def test_a_shifted_session_is_found(truth, perfect, tmp_path, shift, verdict):
    write_place(tmp_path / "place", truth, {1: se2.matrix(*shift)}, made_up=False)
    for name in ("changes.json", "map.npz"):
        shutil.copy(perfect / name, tmp_path / "place" / name)
    scores = score_place(tmp_path / "place", truth.folder)
    assert [one.verdict for one in scores.sessions] == ["right", verdict, "right"]
    one, far = scores.sessions[1], np.hypot(*shift[:2])
    np.testing.assert_allclose([one.start_rotation, one.rotation], np.degrees(shift[2]), atol=1e-3)
    assert one.start_translation == pytest.approx(far, abs=1e-5)
    if shift[2] == 0.0:
        found = [one.translation, one.max_distance, one.median_seam]
        np.testing.assert_allclose(found, far, atol=1e-5)


def test_sessions_of_another_place_must_be_refused(tmp_path):
    scenes = [scene_by_name(f"lookalike-{k}", QUICK) for k in (1, 2)]
    plans = [plan_sessions(scene, 1, k) for k, scene in enumerate(scenes)]
    write_sessions(plans, tmp_path / "days")
    truth = load_session_truth(tmp_path / "days")
    for refused, verdict in (((), "wrong"), ((1,), "refused rightly")):
        write_place(tmp_path / verdict, truth, refused=refused)
        scores = score_place(tmp_path / verdict, truth.folder)
        assert [one.verdict for one in scores.sessions] == ["right", verdict]


def test_changes_that_were_not_found_cost_recall(place, truth):
    (place / "changes.json").write_text("[]")
    changes = score_place(place, truth.folder).changes
    assert changes.recall == 0.0
    assert np.isnan(changes.precision)
    assert (changes.found, changes.events_found, changes.changes) == (0, 0, 0)


def test_changes_of_another_date_are_neither_found_nor_right(place, truth):
    names, path = list(truth.names), place / "changes.json"
    changes = json.loads(path.read_text())
    for one in changes:
        one["between"] = names[1:] if one["between"] == names[:2] else names[:2]
    path.write_text(json.dumps(changes))
    changes = score_place(place, truth.folder).changes
    assert changes.events_found > 0
    assert changes.dates_right < 0.3
    assert changes.f1 < 0.8


def test_ghosts_and_missing_walls_show_in_the_map(place, truth):
    with np.load(place / "map.npz") as file:
        arrays = dict(file)
    p = arrays["p_occupied"]
    rows, columns = np.nonzero(p > 0.65)
    middle = np.median(columns)
    p[rows[columns < middle], columns[columns < middle]] = 0.1
    p[5, 5] = 0.9
    np.savez_compressed(place / "map.npz", **arrays)
    (own,) = score_place(place, truth.folder).maps
    assert 0.3 < own.walls_kept < 0.7
    assert (own.ghost_cells, own.avoidable_ghosts) == (1, 1)


@pytest.mark.parametrize(
    ("file", "text", "error"),
    [
        ("sessions.json", "[", "is not JSON"),
        ("sessions.json", '[{"name": "../x", "accepted": true}]', "is damaged"),
        ("sessions.json", '[{"name": "monday", "accepted": true}]', "is not in"),
        ("changes.json", '{"kind": "gone"}', "is damaged"),
    ],
)
def test_damaged_places_are_refused(place, truth, file, text, error):
    (place / file).write_text(text)
    with pytest.raises(InputError, match=error):
        score_place(place, truth.folder)
