"""Loop verification in 2D: a keyframe is matched with a submap of earlier travel."""

import dataclasses
import functools
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

import stillmap._core as _core
from stillmap.core import se2
from stillmap.core.array_types import Float, Float32, Index
from stillmap.slam import motion_model, scan_matching
from stillmap.slam.local_map import KEYFRAME_ANGLE, select_keyframes_per_sensor
from stillmap.slam.loop_candidates import drift_std
from stillmap.slam.scan_hits import Scan, transform_points
from stillmap.slam.trajectory_cost import same_place_evidence
from stillmap.slam.types import LoopCandidate, LoopClosure, LoopContext

SUBMAP_TRAVEL = 8.0  # m of travel to either side that forms a submap
_SUBMAP_SPACING = 0.25  # of that between keyframes; denser takes longer without being better
# m of travel to either side whose scans are matched along with a keyframe, between these scans, and
# the least isotropy of the information that a view should have
_VIEW_TRAVEL, _VIEW_SPACING, _MIN_ISOTROPY = (1.0, 2.0, 4.0), 1.0, 0.15
_INDEPENDENT_SCANS = 3  # of a view: further ones add no certainty
SEARCH_STDS = 2.0  # half width of the search window in standard deviations of the drift
_OBSERVED_MARGIN = 1.0  # m before the end of a beam where the submap must be observed
MIN_EXPLAINED = 0.5  # share of the comparable beams that the submap must explain
CLOSURE_TRANSLATION, CLOSURE_ROTATION = 0.03, 0.006  # m, rad: min std of a closure
_SHIFTS = (-0.6, -0.3, 0.3, 0.6)  # m, to test whether a view could slide along a wall


def verify_candidates(
    context: LoopContext, candidates: Iterable[LoopCandidate]
) -> list[LoopClosure]:
    """Each candidate matched with the submap of its earlier scan; ordered by the later scan."""
    by_stretch: dict[int, list[LoopCandidate]] = {}
    for candidate in candidates:
        stretch = round(context.travelled[candidate.earlier] / SUBMAP_TRAVEL)
        by_stretch.setdefault(stretch, []).append(candidate)
    found = []
    for stretch, of_stretch in sorted(by_stretch.items()):
        submap = Submap(context, stretch * SUBMAP_TRAVEL)
        found += [
            verify_candidate(context, submap, one, *_total_std(one.drift_distance, one.blind_std))
            for one in of_stretch
        ]
        context.recording.release_pages(context.e)
    return sorted(found, key=lambda closure: closure.later)


def _total_std(metres: float, blind_std: tuple[float, float]) -> tuple[float, float]:
    """m and rad, of the drift over that much travel and of blind steps."""
    translation, rotation = drift_std(metres)
    return float(np.hypot(translation, blind_std[0])), float(np.hypot(rotation, blind_std[1]))


class Submap:
    """Map of the scans around `center` m of travel.

    Attributes:
        grid: for registration.
    """

    def __init__(self, context: LoopContext, center: float) -> None:
        ends = center - SUBMAP_TRAVEL, center + SUBMAP_TRAVEL
        first, last = np.searchsorted(context.travelled, ends)
        spacing = _SUBMAP_SPACING * context.keyframe_distance, _SUBMAP_SPACING * KEYFRAME_ANGLE
        sensor = context.recording.sensor[first:last]
        scans = first + select_keyframes_per_sensor(context.poses[first:last], sensor, *spacing)
        self.grid = context.build_map(scans)
        self._context, self._scans = context, scans

    @functools.cached_property
    def counts(self) -> _core.OccupancyGrid2D:
        """The counts (10), without end points interpolated between beams: these are no evidence."""
        poses = self._context.poses[self._scans]
        return self._context.count_beams(self._scans, poses, everywhere=True)


def verify_candidate(
    context: LoopContext,
    submap: Submap,
    candidate: LoopCandidate,
    translation_std: float,
    rotation_std: float,
) -> LoopClosure:
    """The view of the later scan matched with a submap, within its drift.

    Args:
        context: the trajectory.
        submap: map around the earlier scan.
        candidate: the scans and their relative pose.
        translation_std, rotation_std: of that pose, m and rad.
    """
    earlier, later = candidate.earlier, candidate.later
    mean = context.poses[earlier] @ candidate.T
    prior = motion_model.gaussian_prior(mean, translation_std, rotation_std)
    view = _collect_view(context, later)
    window = SEARCH_STDS * translation_std, min(SEARCH_STDS * rotation_std, np.pi)
    grid = submap.grid
    comparable, _ = _select_comparable(grid, view, prior.T_map_base)
    match = scan_matching.search_pose(grid, comparable, prior, *window)
    part, share = _select_comparable(grid, view, match.T_map_base)
    floor = [CLOSURE_TRANSLATION] * 2 + [CLOSURE_ROTATION]
    covariance = match.covariance + np.diag(np.square(floor))
    score, rejected = 0.0, "explains too little"
    if match.explained >= MIN_EXPLAINED:
        poses = match.T_map_base @ view.to_keyframe
        own = context.count_beams(view.scans, poses, other=submap.counts)
        of_motion = dataclasses.replace(match, covariance=covariance)
        score = same_place_evidence(submap.counts, own)
        score -= scan_matching.motion_cost(prior, of_motion)
        rejected = "" if score > 0.0 else "too little evidence"
    if not rejected:
        # bounded by the drift over the whole way: the graph is no independent measurement
        way = context.travelled[later] - context.travelled[earlier]
        free = _total_std(way, candidate.blind_std)[0]
        covariance += _sliding_covariance(grid, part, match.T_map_base, covariance, free)
        covariance += _ambiguity_covariance(match.alternatives)
    return LoopClosure(
        earlier,
        later,
        se2.inverse(context.poses[earlier]) @ match.T_map_base,
        se2.rotate_covariance(covariance, se2.inverse(match.T_map_base)),
        match.explained,
        rejected,
        share,
        score,
    )


class _View(NamedTuple):
    """A keyframe and scans to either side.

    Attributes:
        scans: of the view.
        to_keyframe: (S, 3, 3) their poses in the frame of the keyframe.
        hits: in that frame.
        before_ends: (N, 2) points before their ends, see `_points_before_ends`.
    """

    scans: Index
    to_keyframe: Float
    hits: Scan
    before_ends: Float32


def _collect_view(context: LoopContext, t: int) -> _View:
    """The view of a keyframe.

    A view of a single wall could slide along it: it grows until surfaces of other directions are in
    it.
    """
    for metres in _VIEW_TRAVEL:
        scans = _select_around(context, t, metres)
        seen = [context.hits(s) for s in scans]
        to_t = se2.inverse(context.poses[t]) @ context.poses[scans]
        hits = _merge_scans(seen, to_t)
        if _isotropy(hits) >= _MIN_ISOTROPY:
            break
    before = [
        transform_points(_points_before_ends(scan, _OBSERVED_MARGIN), T)
        for scan, T in zip(seen, to_t, strict=True)
    ]
    return _View(scans, to_t, hits, np.concatenate(before))


def _select_around(context: LoopContext, t: int, metres: float) -> Index:
    """Scan t, and one per `_VIEW_SPACING` m of travel up to `metres` to either side."""
    here, count = context.travelled[t], round(metres / _VIEW_SPACING)
    at = here + _VIEW_SPACING * np.arange(-count, count + 1)
    after = np.searchsorted(context.travelled, at, side="right")
    scans = np.where(at < here, np.minimum(after, t), np.maximum(after - 1, t))
    # no farther than asked: travel may leap
    near = np.abs(context.travelled[scans] - here) <= metres
    return np.union1d(scans[near], t)


def _merge_scans(scans: list[Scan], to_t: Float) -> Scan:
    """Scans moved by (S, 3, 3) into one frame.

    Neighboring scans share their errors: more of them say where, not more certainly.
    """
    pairs = list(zip(scans, to_t, strict=True))
    share = np.float32(min(1.0, _INDEPENDENT_SCANS / len(scans)))
    return Scan(
        np.concatenate([transform_points(scan.points, T) for scan, T in pairs]),
        share * np.concatenate([scan.weights for scan in scans]),
        scans[0].T_base_sensor,
        np.concatenate([np.float32(scan.normals @ T[:2, :2].T) for scan, T in pairs]),
        np.concatenate([scan.isotropy for scan in scans]),
        np.concatenate([scan.shares for scan in scans]),
    )


def _isotropy(view: Scan) -> float:
    """Information about the least known direction as a share of that about the best known one."""
    weight = view.weights * (1.0 - view.isotropy)
    information = np.einsum("n,ni,nj->ij", weight, view.normals, view.normals)
    information += float((view.weights * view.isotropy).sum()) * np.eye(2)
    least, most = np.linalg.eigvalsh(information)
    return float(least / max(most, 1e-9))


def _points_before_ends(scan: Scan, metres: float) -> Float32:
    """(N, 2) points so far before the ends of the beams, or half way if that is farther out."""
    origin = scan.T_base_sensor[:2, 2].astype(np.float32)
    beams = scan.points - origin
    length = np.linalg.norm(beams, axis=1, keepdims=True).clip(1e-6)
    before: Float32 = origin + beams * np.maximum(0.5, 1.0 - metres / length)
    return before


def _select_comparable(
    submap: _core.OccupancyGrid2D, view: _View, T_map_base: Float
) -> tuple[Scan, float]:
    """The part of a view that the submap observed from the same side, and its share.

    The other beams are no evidence and would bias the match: the back of a wall is not its front.
    """
    before = transform_points(view.before_ends, T_map_base)
    cells = np.floor(before / submap.resolution).astype(np.int64)
    observed = submap.alpha_beta(cells).sum(axis=1) > 0.0
    part = np.where(observed, view.hits.weights, np.float32(0.0))
    share = float(part.sum()) / max(float(view.hits.weights.sum()), 1e-9)
    return dataclasses.replace(view.hits, weights=part), share


def _ambiguity_covariance(alternatives: Float) -> Float:
    """Covariance (3, 3) to add where the view fits elsewhere about as well.

    Spread of a mixture about its best component, weighted by exp(-cost).
    """
    p, offset = np.exp(-alternatives[:, 3]), alternatives[:, :3]
    return np.asarray(np.einsum("r,ri,rj->ij", p / p.sum(), offset, offset))


def _sliding_covariance(
    submap: _core.OccupancyGrid2D, view: Scan, T_map_base: Float, covariance: Float, max_std: float
) -> Float:
    """Covariance (3, 3) to add where a view could slide along a wall.

    The curvature at the optimum mistakes the pattern of end points on a bare wall for information;
    the cost some way off does not.
    """
    along = np.linalg.eigh(covariance[:2, :2])[1][:, 1]  # the least certain direction

    def cost(shift: float) -> float:
        moved = T_map_base.copy()
        moved[:2, 2] += shift * along
        return scan_matching.registration_cost(submap, view, moved)

    best = cost(0.0)
    # a Gaussian of this variance costs as much there
    variances = [0.5 * shift**2 / max(cost(shift) - best, 1e-9) for shift in _SHIFTS]
    added = np.zeros((3, 3))
    added[:2, :2] = min(max(variances), max_std**2) * np.outer(along, along)
    return added
