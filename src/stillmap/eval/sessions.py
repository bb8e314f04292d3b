"""Scores of a place that `stillmap merge` made of simulated sessions."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.core.errors import InputError
from stillmap.eval.labels import Scores
from stillmap.eval.session_cells import collect_cells
from stillmap.eval.session_changes import ChangeScores, score_changes
from stillmap.eval.session_found import read_changes, read_named_cells
from stillmap.eval.session_labels import PlaceLabelScores, score_place_labels
from stillmap.eval.session_maps import SessionMapScores, score_place_map, score_single
from stillmap.eval.session_poses import (
    PlacedSession,
    PoseScores,
    align_place,
    read_sessions,
    score_poses,
)
from stillmap.eval.session_truth import SessionTruth, load_session_truth
from stillmap.eval.session_voxels import collect_voxels
from stillmap.results.reader import read_grid, require_there

Float = NDArray[np.float64]


@dataclass(frozen=True)
class PlaceScores(Scores):
    """Scores of a place.

    Attributes:
        sessions: poses of each session, in the order of the place.
        right, coarse, wrong, refused, refused_rightly: how many have this verdict.
        T_world_place: by which the place was laid on the world.
        changes: between the sessions.
        labels: of all sessions; None in 2D.
        maps: of the place, then of results of single sessions; none in 3D.
    """

    sessions: tuple[PoseScores, ...]
    right: int
    coarse: int
    wrong: int
    refused: int
    refused_rightly: int
    T_world_place: tuple[tuple[float, ...], ...]
    changes: ChangeScores
    labels: PlaceLabelScores | None
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
    labels: PlaceLabelScores | None = None
    maps: tuple[SessionMapScores, ...] = ()
    if truth.dimension == 2:
        changes, maps = _score_in_plane(place, truth, by_date, T_world_place, singles)
    else:
        changes, labels = _score_in_space(place, truth, by_date, T_world_place)
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
        labels,
        maps,
    )


def _score_in_plane(
    place: Path,
    truth: SessionTruth,
    sessions: list[PlacedSession],
    T_world_place: Float,
    singles: Sequence[Path],
) -> tuple[ChangeScores, tuple[SessionMapScores, ...]]:
    """Changes and maps of a place in 2D."""
    numbers = [one.number for one in sessions]
    cells = collect_cells(truth, numbers)
    named = read_named_cells(place, T_world_place)
    found = read_changes(place, sessions, T_world_place, cells, named)
    source = "boxes" if named is None else "cells"
    changes = score_changes(found, source, cells, truth, numbers)
    everyone = list(range(len(numbers)))
    own = score_place_map(
        place.name, read_grid(place), T_world_place, truth, cells, numbers, everyone
    )
    return changes, (own, *(score_single(one, truth, cells, numbers) for one in singles))


def _score_in_space(
    place: Path, truth: SessionTruth, sessions: list[PlacedSession], T_world_place: Float
) -> tuple[ChangeScores, PlaceLabelScores]:
    """Changes and labels of a place in 3D."""
    named = read_named_cells(place, T_world_place)
    if named is None:
        raise InputError("does not exist", where=str(place / "changes.npz"))
    numbers = [one.number for one in sessions]
    cells = collect_voxels(truth, numbers, named.points)
    found = read_changes(place, sessions, T_world_place, cells, named)
    changes = score_changes(found, "cells", cells, truth, numbers)
    return changes, score_place_labels(place, sessions, truth, cells)
