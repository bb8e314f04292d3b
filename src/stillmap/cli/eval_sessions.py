"""Compute and format the scores of `stillmap eval sessions`."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from stillmap.cli.eval_scores import Scores
from stillmap.eval.session_changes import ChangeScores
from stillmap.eval.session_labels import PlaceLabelScores
from stillmap.eval.session_maps import SessionMapScores
from stillmap.eval.session_poses import PoseScores
from stillmap.eval.sessions import PlaceScores, score_place


def score_sessions(place: Path, truth: Path, singles: Sequence[Path]) -> Scores:
    """Poses, changes and map of a place."""
    scores = score_place(place, truth, singles)
    return scores.to_dict(), _format(scores)


def _format(s: PlaceScores) -> Iterable[str]:
    yield (
        f"sessions     {len(s.sessions)}: {s.right} right, {s.coarse} coarse, {s.wrong} wrong, "
        f"{s.refused} refused, {s.refused_rightly} refused rightly"
    )
    yield from map(_format_session, s.sessions)
    yield from _format_changes(s.changes)
    if s.labels is not None:
        yield _format_labels(s.labels)
    yield from map(_format_map, s.maps)


def _format_session(s: PoseScores) -> str:
    if s.verdict.startswith("refused") or s.translation != s.translation:
        return f"  {s.name:14} {s.verdict}"
    return (
        f"  {s.name:14} {s.verdict}: off by {s.translation:.3f} m, {s.rotation:.3f} deg, "
        f"at its start {s.start_translation:.3f} m, {s.start_rotation:.3f} deg, "
        f"poses mean {s.mean_distance:.3f} m, max {s.max_distance:.3f} m, "
        f"seams median {s.median_seam:.3f} m, max {s.max_seam:.3f} m"
    )


def _format_changes(s: ChangeScores) -> Iterable[str]:
    yield (
        f"changed      F1 {s.f1:.4f}, precision {s.precision:.4f}, recall {s.recall:.4f} "
        f"of {s.cells} cells (by {s.source})"
    )
    yield (
        f"events       {s.events_found} of {s.events} found, dates right "
        f"{100 * s.dates_right:.1f} %; {s.spurious} of {s.changes} changes spurious"
    )


def _format_labels(s: PlaceLabelScores) -> str:
    return (
        f"labels       F1 {s.beams.f1:.4f}, precision {s.beams.precision:.4f}, recall "
        f"{s.beams.recall:.4f} of {s.beams.dynamic} dynamic hits; {100 * s.gone_found:.2f} % of "
        f"{s.gone} on what is gone found, {100 * s.stays_kept:.2f} % on what stays kept"
    )


def _format_map(s: SessionMapScores) -> str:
    return (
        f"map {s.name}: {s.ghost_cells} ghost cells of {s.occupied_cells} occupied "
        f"({s.ghosts_per_100_m2:.3f} per 100 m2 free), {s.avoidable_ghosts} avoidable; "
        f"walls kept {100 * s.walls_kept:.2f} % of {s.wall_cells} cells"
    )
