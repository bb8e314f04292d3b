"""Sessions of a street in 3D: where they lie, what changed, and that growing is merging."""

import filecmp
from functools import partial
from pathlib import Path

import pytest
from flat import list_files
from place_scores import PlaceScores, score_place
from place_truth import load_session_truth

import stillmap
from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.sim import scene_by_name
from stillmap.sim.sessions import draw_piece, plan_sessions, write_sessions

pytestmark = pytest.mark.slow  # a minute: three sessions are simulated, mapped and merged twice

SWEEPS = {"lidar": {"channels": 12, "columns": 300}, "robot": {"scans": 30}}
OPTIONS = {"em.max_iterations": 1, "threads": 1}
BEGINS = (40.0, 41.0, 39.0)  # m along the street


def build(days: Path, name: str) -> Path:
    """The result of a session at its true poses, in the frame of the first one."""
    truth = load_session_truth(days)
    world = truth.beams(truth.names.index(name)).T_world_base
    poses = se2.inverse(world[0]) @ world
    stillmap.build(days / name, OPTIONS, poses=poses).save(days.parent / name)
    return days.parent / name


@pytest.fixture(scope="module")
def days(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("street") / "days"
    scene = scene_by_name("street-empty", SWEEPS)
    routes = [partial(draw_piece, begin=begin) for begin in BEGINS]
    write_sessions([plan_sessions(scene, 3, 3, routes=routes)], folder)
    return folder


@pytest.fixture(scope="module")
def results(days: Path) -> list[Path]:
    return [build(days, f"session-{k}") for k in (1, 2, 3)]


@pytest.fixture(scope="module")
def place(results: list[Path]) -> Path:
    stillmap.merge(results, options=OPTIONS, output=results[0].parent / "place")
    return results[0].parent / "place"


@pytest.fixture(scope="module")
def scores(place: Path, days: Path) -> PlaceScores:
    return score_place(place, days)


def test_sessions_lie_where_they_truly_are(scores: PlaceScores) -> None:
    assert [one.verdict for one in scores.sessions] == ["right"] * 3
    assert max(one.translation for one in scores.sessions) < 0.05


def test_changes_and_labels_are_right(scores: PlaceScores) -> None:
    changes, labels = scores.changes, scores.labels
    assert labels is not None
    assert changes.f1 > 0.8
    assert changes.spurious == 0
    assert labels.gone > 1000
    assert labels.gone_found > 0.9
    assert labels.stays_kept > 0.999


def test_growing_gives_the_same_files_as_merging_at_once(
    results: list[Path], place: Path, tmp_path: Path
) -> None:
    stillmap.merge(results[:2], options=OPTIONS, output=tmp_path / "two")
    grown = tmp_path / "three"
    stillmap.merge([tmp_path / "two", results[2]], options=OPTIONS, output=grown)
    assert list_files(grown) == list_files(place)
    same = {name for name in list_files(place) if filecmp.cmp(place / name, grown / name, False)}
    assert list_files(place) - same == {"run.json"}  # its options have the cells of the place


def test_another_street_is_refused(results: list[Path], tmp_path: Path) -> None:
    scene = scene_by_name("crossing-empty", SWEEPS)
    plan = plan_sessions(scene, 1, 4, routes=[partial(draw_piece, begin=60.0)])
    write_sessions([plan], tmp_path / "days")
    other = build(tmp_path / "days", "session-1")
    with pytest.raises(InputError, match="fewer than two sessions"):
        stillmap.merge([results[0], other], options=OPTIONS, output=tmp_path / "place")
