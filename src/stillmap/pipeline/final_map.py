"""After the loop: the last E-step, the maps, the objects, the changes, all of the best estimate."""

import dataclasses
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

import stillmap._core as _core
from stillmap import em, mapping, slam
from stillmap.core.array_types import Float, Index
from stillmap.core.parallel import resolve_threads, trim_heap
from stillmap.core.profiling import Progress, StageTimer
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.em import GroundMap, estimate_ground
from stillmap.mapping.labelled_recording import LabelledRecording
from stillmap.mapping.lone_leaves import find_leaf_lines
from stillmap.mapping.projection import project_cells, project_to_plane
from stillmap.mapping.reflections import P_REFLECTED, remove_reflections
from stillmap.pipeline.em_loop import Estimate
from stillmap.pipeline.options import Options
from stillmap.tracking import MovingObject, track_objects
from stillmap.tracking.motion_evidence import apply_motion_evidence
from stillmap.tracking.objects_3d import track_objects_3d

_MIN_TRAVEL = 1.5  # m: leaves of doors swing less far


@dataclass(frozen=True, eq=False)
class Maps(ShortRepr):
    """Maps of the same cells.

    Attributes:
        filtered: of what is static.
        raw: every hit counted as static, from the same poses.
        evidence: observation counts of these cells.
        ground: height of the ground; None in 2D.
        beyond: (K, 2) m, places with hits that lie outside, where the box around everything would
            be nearly empty.
    """

    filtered: em.OccupancyMap
    raw: em.OccupancyMap
    evidence: em.Coverage
    ground: GroundMap | None
    beyond: Float = field(default_factory=lambda: np.zeros((0, 2)))


class FinalEstimate(NamedTuple):
    """The estimate with the labels of the map as it is shown.

    Attributes:
        deskewed: the recording without motion during its scans.
        estimate: with these labels.
        changes: places that changed.
        doors: of which those that were seen to swing are among the changes, too.
    """

    deskewed: Recording
    estimate: Estimate
    changes: list[mapping.Change]
    doors: list[mapping.Door]


def final_estimate(recording: Recording, best: Estimate, options: Options) -> FinalEstimate:
    """The last E-step."""
    threads = resolve_threads(options.threads)
    deskewed = slam.deskew_recording(recording, best.poses, options.slam, threads)
    cell, look = options.slam.resolution, options.em.time_bin
    changed = best.e_step.changed_cells
    if changed is not None:  # 3D: every E-step knows of them
        changes = mapping.detect_changes_3d(changed, deskewed, best.poses, cell, look)
        return FinalEstimate(deskewed, best, changes, [])
    if recording.dimension == 3 or options.estimator != "stillmap":
        return FinalEstimate(deskewed, best, [], [])
    deskewed, reflected = remove_reflections(deskewed, best.poses, best.p_static, cell)
    found, courses = em.final_e_step(deskewed, best.poses, cell, options.em, threads)
    if reflected is not None:  # unusable beams have no label
        hit = recording.hit[reflected]
        found.p_static[reflected] = np.where(hit, P_REFLECTED, options.em.prior)
    best = best.with_labels(p_static=found.p_static, occupied=found.occupied, learned=found.learned)
    if courses is None:
        return FinalEstimate(deskewed, best, [], [])
    known = LabelledRecording(deskewed, best.poses, best.p_static, cell, threads)
    best, movers = _add_motion_evidence(known, best, courses)
    known = known._replace(p_static=best.p_static)
    changes = mapping.detect_changes(courses, deskewed, cell, look, movers)
    surface = courses.cells[courses.p_in_map("majority") > 0.5]
    lines = find_leaf_lines(known)
    every = mapping.detect_changes(courses, deskewed, cell, look)  # of dynamic hits, too
    found_doors = mapping.find_doors(every, lines, surface, known)
    changes = mapping.join_doors(changes, found_doors)
    swung = [one.door for one in changes if one.door is not None]
    lone = mapping.find_lone_doors(surface, swung, known)
    # changed places and doors as the map shows them
    occupied, state = best.e_step.known_cells, options.output.map_state
    p_static, occupied = mapping.relabel_changes(known, occupied, courses, changes, state)
    known = known._replace(p_static=p_static)
    p_static, occupied = mapping.relabel_lone_doors(known, occupied, courses, lone, state)
    learned = {**best.e_step.learned, "changing": round(courses.changing_weight, 6)}
    best = best.with_labels(p_static=p_static, occupied=occupied, learned=learned)
    return FinalEstimate(deskewed, best, changes, [*swung, *lone])


def _add_motion_evidence(
    known: LabelledRecording, best: Estimate, courses: em.CellHistories
) -> tuple[Estimate, mapping.MoverPoints]:
    """Labels of beams and cells, given which tracks are movers; the end points on these."""
    noise_std = courses.surfel_map.noise_std
    p_static, movers = apply_motion_evidence(*known[:3], noise_std)
    occupied = mapping.update_occupancy(known, p_static, courses, best.e_step.known_cells)
    return best.with_labels(p_static=p_static, occupied=occupied), movers


def make_maps(
    final: FinalEstimate, options: Options, progress: Progress, stages: StageTimer
) -> Maps:
    """The maps of an estimate; of 3D recordings, of the obstacles projected to the plane."""
    deskewed, estimate, threads = final.deskewed, final.estimate, resolve_threads(options.threads)
    progress("making the map", 0, 0, 0)
    with stages.measure("maps"):
        planar, ground = deskewed, None
        if deskewed.dimension == 3:
            ground = estimate.e_step.ground or estimate_ground(
                deskewed, estimate.poses, estimate.p_static, threads
            )
            planar, estimate = _project(deskewed, estimate, ground, options, threads)
        filtered, raw, beyond = _occupancy_maps(planar, estimate, options, threads)
    trim_heap()
    progress("counting observations", 0, 0, 0)
    with stages.measure("evidence"):
        evidence = em.count_observations(
            planar,
            estimate.poses,
            estimate.p_static,
            filtered,
            estimate.e_step.no_return,
            options.em,
            threads,
        )
    return Maps(filtered, raw, evidence, ground, beyond)


def _project(
    deskewed: Recording, estimate: Estimate, ground: GroundMap, options: Options, threads: int
) -> tuple[Recording, Estimate]:
    """A 3D recording and its estimate as planar ones: the obstacles above the ground."""
    cell, output = options.slam.resolution, options.output
    band = (output.min_obstacle_height, output.max_obstacle_height)
    plan = project_to_plane(
        deskewed, estimate.poses, ground, band, cell, open_space=False, threads=threads
    )
    occupied = estimate.e_step.occupied
    if occupied is not None:
        occupied = project_cells(occupied, ground, band, cell)
    planar = dataclasses.replace(
        estimate,
        weights=estimate.weights[plan.beam],
        m_step=dataclasses.replace(estimate.m_step, poses=plan.poses),
    )
    p_static = estimate.p_static[plan.beam]
    deskewed.release_pages(estimate.weights, estimate.p_static)
    return plan.recording, planar.with_labels(p_static=p_static, occupied=occupied, no_return=None)


def _occupancy_maps(
    planar: Recording, estimate: Estimate, options: Options, threads: int
) -> tuple[em.OccupancyMap, em.OccupancyMap, Float]:
    """The map, the same cells with every hit counted as static, and places with hits outside.

    Labels that follow from the sums go with the weights that made the sums; others make them.
    """
    e_step = estimate.e_step
    labels_make_sums = options.estimator in ("stillmap", "tracker")
    weights = estimate.p_static if labels_make_sums else estimate.weights
    grid = _core.OccupancyGrid2D(options.slam.resolution, moments=False)
    places, scratch = _wanted_places(planar, estimate, options), planar.scratch
    seen = em.add_trusted_beams(
        grid, planar, estimate.poses, weights, e_step.no_return, threads, places
    )
    filtered = em.make_occupancy_map(grid, e_step.occupied, seen, scratch=scratch, places=places)
    em.recount_as_static(grid, planar, estimate.poses, weights)
    raw = em.make_occupancy_map(grid, window=filtered.window, scratch=scratch)
    return filtered, raw, em.find_hits_beyond(grid, filtered.window)


def _wanted_places(planar: Recording, estimate: Estimate, options: Options) -> Float:
    """(K, 2) m, around which a map lies that cannot be whole: the region, or all sensors."""
    if options.output.region is not None:
        x0, y0, x1, y1 = options.output.region
        return np.array([[x0 + x1, y0 + y1]]) / 2.0
    return np.asarray(planar.T_map_sensor(estimate.poses)[:, :2, 2])


def find_objects(final: FinalEstimate, maps: Maps, options: Options) -> list[MovingObject]:
    """Moving objects; in 2D without those whose beams ended on a door or what is a change."""
    deskewed, estimate, changes, doors = final
    poses, p_static = estimate.poses, estimate.p_static
    if maps.ground is not None:
        threads = resolve_threads(options.threads)
        return track_objects_3d(deskewed, poses, p_static, maps.ground, options.objects, threads)
    objects = track_objects(deskewed, poses, p_static, options.objects)
    known = LabelledRecording(deskewed, poses, p_static, maps.filtered.resolution)
    changed = mapping.find_changed_object_beams(known, changes, doors)
    moved = [one for one in objects if not _is_change(one, changed, deskewed)]
    return [dataclasses.replace(one, id=k) for k, one in enumerate(moved)]


def _is_change(one: MovingObject, changed: Index, recording: Recording) -> bool:
    """True if an object is a listed change or the leaf of a door, not a mover that stood there.

    More than half of its beams are among `changed` (rising), and in the scans in which they are
    not, its path extends over less than `_MIN_TRAVEL`.
    """
    is_changed = np.isin(one.beams, changed, assume_unique=True)
    if 2 * np.count_nonzero(is_changed) <= len(one.beams):
        return False
    scan, of = np.unique(recording.scans_of(one.beams), return_inverse=True)
    elsewhere = scan[2 * np.bincount(of, is_changed) < np.bincount(of)]
    xy = one.xy[np.isin(one.scan, elsewhere)]
    return not len(xy) or float(np.linalg.norm(np.ptp(xy, axis=0))) < _MIN_TRAVEL
