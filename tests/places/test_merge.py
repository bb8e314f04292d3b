"""Merging sessions from start to end: what is written, growing, refusals, and frames."""

import filecmp
import json
import re

import numpy as np
import pytest
from flat import list_files
from report_page import Page

from stillmap.cli.main import main
from stillmap.core import se2
from stillmap.io.trajectory import read_tum
from stillmap.results.reader import read_grid, read_labels
from stillmap.results.report.place import PlacePictures
from stillmap.results.timeline import read_timeline

# what a result of one recording has, and what a place adds
FILES = {
    *("map.pgm", "map.yaml", "map.npz", "trajectory.tum", "graph.g2o", "run.json", "traffic.npz"),
    *("beams", "objects", "sessions", "sessions.json", "changes.json", "changes.npz", "states.npz"),
    "ties.npz",
}


def merge(*words):
    return main(["merge", *map(str, words), "--quiet", "--threads", "1"])


def records(place):
    return json.loads((place / "sessions.json").read_text())


def differing_files(one, other):
    assert list_files(one) == list_files(other)
    return {name for name in list_files(one) if not filecmp.cmp(one / name, other / name, False)}


def test_a_place_has_all_files(place):
    assert {path.name for path in place.iterdir()} >= FILES
    for name in ("out-1", "out-2", "out-3"):
        home = place / "sessions" / name
        assert {"trajectory.tum", "beams", "objects"} <= {path.name for path in home.iterdir()}


def test_sessions_lie_where_they_truly_are(days, place):
    truth = json.loads((days / "sim" / "sessions.json").read_text())["sessions"]
    T_world = [np.array(one["T_world_session"]) for one in truth]
    found = records(place)
    assert [one["name"] for one in found] == ["out-1", "out-2", "out-3"]
    for one, T in zip(found, T_world, strict=True):
        assert one["accepted"]
        error = se2.parameters(se2.inverse(se2.inverse(T_world[0]) @ T) @ one["T_place_session"])
        assert np.hypot(*error[:2]) < 0.08
        assert abs(np.degrees(error[2])) < 0.5
        assert np.linalg.eigvalsh(one["covariance"])[0] >= 0.0
        assert 0.0 <= one["overlap"] <= 1.0


def test_the_place_is_rated_by_its_geometry(place):
    quality = json.loads((place / "run.json").read_text())["quality"]
    assert quality["labels"] is None
    assert 50.0 < quality["geometry"] == quality["overall"] <= 100.0


def test_the_trajectory_of_the_place_is_that_of_its_sessions(place):
    stamps, poses = read_tum(place / "trajectory.tum")
    parts = [read_tum(place / "sessions" / f"out-{k}" / "trajectory.tum") for k in (1, 2, 3)]
    np.testing.assert_array_equal(stamps, np.concatenate([part[0] for part in parts]))
    np.testing.assert_allclose(poses, np.concatenate([part[1] for part in parts]), atol=1e-9)
    labels = read_labels(place)
    np.testing.assert_array_equal(labels.stamp_ns, stamps)
    own = np.concatenate([read_labels(place / "sessions" / f"out-{k}").p_static for k in (1, 2, 3)])
    np.testing.assert_array_equal(labels.p_static, own)


def test_labels_follow_what_all_sessions_saw(days, place):
    """What was taken away after the first session is dynamic in it, walls are not."""
    truth = json.loads((days / "sim" / "sessions.json").read_text())
    thing = np.load(days / "sim" / "session-1" / "truth" / "thing.npy")
    gone = [
        number
        for number, one in enumerate(truth["objects"])
        if one["at"][0] is not None and one["at"][0] not in one["at"][1:]
    ]
    labels = read_labels(place / "sessions" / "out-1")
    alone = read_labels(days / "out-1")
    on_gone = np.isin(thing, gone) & labels.hit
    if on_gone.sum() < 200:
        pytest.skip("the first session hardly saw what was taken away")
    assert np.mean(labels.p_static[on_gone] < 0.5) > np.mean(alone.p_static[on_gone] < 0.5) + 0.3
    others = (thing < 0) & labels.hit & (alone.p_static > 0.9)
    assert np.mean(labels.p_static[others] > 0.5) > 0.98


@pytest.mark.slow
def test_growing_gives_the_same_files_as_merging_at_once(days, place, tmp_path):
    assert merge(days / "out-1", days / "out-2", "-o", tmp_path / "two") == 0
    before = {name: (tmp_path / "two" / name).read_bytes() for name in list_files(tmp_path / "two")}
    assert merge(tmp_path / "two", days / "out-3", "-o", tmp_path / "three") == 0
    assert differing_files(place, tmp_path / "three") == set()
    for name, content in before.items():  # the place that grew is as it was
        assert (tmp_path / "two" / name).read_bytes() == content


@pytest.mark.slow
def test_the_number_of_threads_does_not_matter(days, place, tmp_path):
    results = [str(days / f"out-{k}") for k in (1, 2, 3)]
    assert main(["merge", *results, "-o", str(tmp_path / "x"), "--quiet", "--threads", "2"]) == 0
    assert differing_files(place, tmp_path / "x") == {"run.json"}  # its options


@pytest.mark.slow
def test_the_frame_of_another_session(days, place, tmp_path):
    results = [days / f"out-{k}" for k in (1, 2, 3)]
    assert merge(*results, "-o", tmp_path / "x", "--frame", "out-2") == 0
    found = records(tmp_path / "x")
    np.testing.assert_allclose(found[1]["T_place_session"], np.eye(3), atol=1e-9)
    T = [np.array(one["T_place_session"]) for one in records(place)]
    expected = se2.inverse(T[1]) @ T[2]
    difference = se2.parameters(se2.inverse(expected) @ found[2]["T_place_session"])
    assert np.abs(difference).max() < 0.02


@pytest.mark.slow
def test_the_map_shows_the_state_that_is_asked_for(days, place, tmp_path):
    results = [days / f"out-{k}" for k in (1, 2, 3)]
    assert merge(*results, "-o", tmp_path / "x", "--map-state", "out-1") == 0
    last, first = read_grid(place), read_grid(tmp_path / "x")
    changes = json.loads((place / "changes.json").read_text())
    assert changes
    assert json.loads((tmp_path / "x" / "changes.json").read_text()) == changes
    differ = first.occupied != last.occupied
    assert differ.any()
    centres = first.centres(np.argwhere(differ))
    inside = np.zeros(len(centres), bool)
    margin = 2 * first.resolution
    for one in changes:
        for x0, y0, x1, y1 in (one["box"], one.get("from_box", one["box"])):
            low, high = np.array([x0, y0]) - margin, np.array([x1, y1]) + margin
            inside |= ((centres >= low) & (centres <= high)).all(axis=1)
    assert inside.mean() > 0.8


def test_sessions_of_unrelated_places_are_refused(days, tmp_path, capsys):
    words = ["simulate", "office", "-o", str(tmp_path / "sim"), "--scans", "260", "--quiet"]
    assert main(words) == 0
    assert merge(days / "out-1", tmp_path / "sim", "-o", tmp_path / "x") == 2
    message = capsys.readouterr().err
    assert "fewer than two sessions could be placed: sim: " in message
    assert len(message.splitlines()) == 1
    assert not (tmp_path / "x").exists()


def test_merge_writes_the_report(place):
    page = Page((place / "report.html").read_text(encoding="utf-8"))
    changes = json.loads((place / "changes.json").read_text())
    assert changes
    listed = [row[1] for row in page.rows if re.fullmatch(r"[AGMD]\d+", row[0])]
    assert listed == [one["kind"] for one in changes]


def test_map_as_of_the_last_session_is_the_map(place):
    pictures = PlacePictures(read_grid(place), read_timeline(place))
    shown, of_last = (
        np.array(one.convert("RGB")) for one in (pictures.draw_map(), pictures.draw(2))
    )
    colored = np.ptp(of_last.astype(int), axis=2) > 30  # what changed since the second one
    assert 0 < colored.sum() < 0.02 * colored.size
    assert (shown == of_last)[~colored].all()
