"""Scores of a place that `stillmap merge` made of simulated sessions."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from stillmap.eval.labels import Scores
from stillmap.eval.session_cells import collect_cells
from stillmap.eval.session_changes import ChangeScores, read_changes, score_changes
from stillmap.eval.session_maps import SessionMapScores, score_place_map, score_single
from stillmap.eval.session_poses import (
    PoseScores,
    align_place,
    read_sessions,
    score_poses,
)
from stillmap.results.reader import read_grid, require_there
from stillmap.sim.session_truth import load_session_truth


@dataclass(frozen=True)
class PlaceScores(Scores):
    """Scores of a place; changes and maps of planar ones only.

    Attributes:
        sessions: poses of each session, in the order of the place.
        right, coarse, wrong, refused, refused_rightly: how many have this verdict.
        T_world_place: by which the place was laid on the world.
        changes: between the sessions; None in 3D.
        maps: of the place, then of results of single sessions; none in 3D.
    """

    sessions: tuple[PoseScores, ...]
    right: int
    coarse: int
    wrong: int
    refused: int
    refused_rightly: int
    T_world_place: tuple[tuple[float, ...], ...]
    changes: ChangeScores | None
    maps: tuple[SessionMapScores, ...]


def score_place(place: Path, truth_folder: Path, singles: Sequence[Path] = ()) -> PlaceScores:
    """Score a place.

    Args:
        place: what `stillmap merge` wrote.
        truth_folder: what `stillmap simulate --sessions` wrote.
        singles: results of `stillmap map` of single sessions, for comparison of the maps.

    Raises:
        InputError: a file is missing or damaged, or does not match the others.
    """
    require_there(place, truth_folder, *singles)
    truth = load_session_truth(truth_folder)
    placed = read_sessions(place, truth)
    scores = score_poses(placed, truth)
    T_world_place, home = align_place(placed, truth)
    at_home = [one for one in placed if one.accepted and truth.place[one.number] == home]
    by_date = sorted(at_home, key=lambda one: one.number)
    changes: ChangeScores | None = None
    maps: tuple[SessionMapScores, ...] = ()
    if truth.dimension == 2:
        numbers = [one.number for one in by_date]
        cells = collect_cells(truth, numbers)
        found, source = read_changes(place, by_date, T_world_place, cells)
        changes = score_changes(found, source, cells, truth, numbers)
        everyone = list(range(len(numbers)))
        own = score_place_map(
            place.name, read_grid(place), T_world_place, truth, cells, numbers, everyone
        )
        maps = (own, *(score_single(one, truth, cells, numbers) for one in singles))
    verdicts = [one.verdict for one in scores]
    return PlaceScores(
        tuple(scores),
        verdicts.count("right"),
        verdicts.count("coarse"),
        verdicts.count("wrong"),
        verdicts.count("refused"),
        verdicts.count("refused rightly"),
        tuple(tuple(row) for row in T_world_place.tolist()),
        changes,
        maps,
    )
