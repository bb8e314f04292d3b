"""Scores of the labels of a place: static is what did not move, and stands there at the end."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.core.errors import InputError
from stillmap.eval.labels import LabelScores, Scores, score_labels
from stillmap.eval.session_cells import MIN_BEAMS
from stillmap.eval.session_poses import PlacedSession
from stillmap.eval.session_truth import SessionTruth
from stillmap.eval.session_voxels import VoxelTruth
from stillmap.results.reader import read_labels

Bool = NDArray[np.bool_]


@dataclass(frozen=True)
class PlaceLabelScores(Scores):
    """Scores of the labels of all sessions of a place that shows its last state.

    Truly dynamic are movers, and what a later session saw gone: at least MIN_BEAMS of its beams
    passed there.

    Attributes:
        beams: of all hits; positive is dynamic.
        gone: hits on what is gone.
        gone_found: share of these that are called dynamic.
        stays_kept: share of the hits on what stands there in all sessions that are called static.
    """

    beams: LabelScores
    gone: int
    gone_found: float
    stays_kept: float


def score_place_labels(
    place: Path, sessions: list[PlacedSession], truth: SessionTruth, cells: VoxelTruth
) -> PlaceLabelScores:
    """Score the labels of a place.

    Args:
        place: the folder.
        sessions: the accepted ones, by date.
        truth: of all sessions.
        cells: the truth about the voxels of these sessions.

    Raises:
        InputError: a file is missing, damaged, or of another recording.
    """
    columns = []
    for k, one in enumerate(sessions):
        labels = read_labels(place / "sessions" / one.name)
        beams, changed = truth.beams(one.number), truth.changed_beams(one.number)
        if len(labels.p_static) != len(beams.static):
            what = f"has {len(labels.p_static)} beams, the truth {len(beams.static)}"
            raise InputError(what, where=str(place / "sessions" / one.name))
        gone = _find_gone(k, changed, beams.T_world_base, cells)
        stays = beams.static & (changed < 0)
        columns.append((labels.p_static, beams.static & ~gone, labels.hit, gone, stays))
    p, static, hit, gone, stays = (np.concatenate(column) for column in zip(*columns, strict=True))
    labelled = hit & ~np.isnan(p)
    gone, stays = gone & labelled, stays & labelled
    return PlaceLabelScores(
        score_labels(p, static, hit),
        int(gone.sum()),
        _share(p[gone] < 0.5),
        _share(p[stays] >= 0.5),
    )


def _find_gone(
    session: int, changed: NDArray[np.int32], poses: NDArray[np.float64], cells: VoxelTruth
) -> Bool:
    """(M,) the beams of a session on what stood there and a later session saw gone.

    session: index among those of `cells`. changed: (M,) index of the object, or -1.
    """
    beams = np.flatnonzero(changed >= 0)
    at = cells.voxels.find(cells.recordings[session].end_points(beams, poses))
    gone = np.zeros(len(cells.fixed), bool)
    for k in range(session + 1, len(cells.seen)):
        gone |= cells.seen[k].passes >= MIN_BEAMS
        gone &= ~cells.surfaces[k]
    out = np.zeros(len(changed), bool)
    out[beams] = gone[at] & (at >= 0)
    return out


def _share(of: Bool) -> float:
    return float(of.mean()) if len(of) else float("nan")
