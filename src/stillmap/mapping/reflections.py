"""Reflections: beams that a mirror sent elsewhere, so that a room seems to lie behind it.

Lines along walls are searched for pieces behind which what is seen, reflected back, fits what is
before them (`mirrors`); all beams that cross such a piece from its front are reflections.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from stillmap.core.array_types import Bool, Float, Float32
from stillmap.core.chunks import iter_beams
from stillmap.core.recording import Recording
from stillmap.mapping.mirrors import (
    BIN,
    MIN_BEAMS,
    MIN_BEHIND,
    Beams,
    CrossingBeams,
    Mirror,
    SurfaceCells,
    check_mirror,
    iter_lines,
    reflect,
    tangent_of,
)

_MAX_PASSES = 3
_MAX_SAMPLE = 60_000  # beams, of whole scans, that mirrors are searched with
P_REFLECTED = 0.02  # P(c = 1) of reflected beams

_MIN_WIDTH, _MAX_GAP = 0.6, 0.5  # m of a mirror; m in it that nothing was seen through
_MIN_GAP_SHARE = 0.3  # in such a gap, of what is seen
_MIN_BEAMS_PER_BIN = 3
_MIN_BIN_SHARE = 0.5  # of the beams of a bin and those beside, that fit
# m from a wall line to the mirror on or in the wall
_OFFSETS = (0.0, 0.04, -0.04, 0.08, -0.08, 0.12, -0.12, 0.16, -0.16, 0.2, -0.2)
_MAX_TRIED = 1000  # beams that these are tried with


def remove_reflections(
    recording: Recording, poses: Float, p_static: Float32, resolution: float
) -> tuple[Recording, Bool | None]:
    """The recording with the beams that mirrors reflected marked as unusable, and their mask (M,).

    Arguments as of `find_mirrors`. Without mirrors the recording itself, and None.
    """
    reflected = None
    for _ in range(_MAX_PASSES):  # what one mirror shows may hide another
        mirrors = find_mirrors(recording, poses, p_static, resolution)
        if not mirrors:
            break
        more = find_reflections(recording, poses, mirrors)
        reflected = more if reflected is None else reflected | more
        points, hit = recording.copy_beams()
        points[more], hit[more] = np.nan, False
        recording = replace(recording, points=points, hit=hit)
    return recording, reflected


def find_mirrors(
    recording: Recording, poses: Float, p_static: Float32, resolution: float
) -> list[Mirror]:
    """The mirrors of a place.

    Args:
        recording: 2D, deskewed, M beams.
        poses: (T, 3, 3) T_map_base.
        p_static: (M,) P(c = 1).
        resolution: edge of a cell, metres.
    """
    beams = _sample_beams(recording, poses, p_static)
    surfaces = SurfaceCells(beams.ends, beams.is_static, resolution)
    mirrors: list[Mirror] = []
    for normal, distance in iter_lines(surfaces.cells, resolution):
        for side in (1.0, -1.0):
            on_line = list(_find_on_line(beams, surfaces, side * normal, side * distance))
            for mirror in on_line:  # the lines beside would show it again
                beams = beams.without(mirror.find_crossing(beams.origins, beams.ends))
            mirrors += on_line
    return mirrors


def find_reflections(recording: Recording, poses: Float, mirrors: list[Mirror]) -> Bool:
    """(M,) mask of the beams that mirrors reflected, with or without a return."""
    is_reflected = np.zeros(recording.n_beams, np.bool_)
    for _, beams, data in iter_beams(recording, poses):
        scan = np.repeat(np.arange(len(data.T_map_sensor)), np.diff(data.offset))
        T = data.T_map_sensor[scan]
        origins = T[:, :2, 2]
        ends = origins + np.einsum("nij,nj->ni", T[:, :2, :2], data.points.astype(np.float64))
        usable = np.isfinite(ends[:, 0])
        ends[~usable] = origins[~usable]
        for mirror in mirrors:
            is_reflected[beams] |= mirror.find_crossing(origins, ends)
    return is_reflected


def _sample_beams(recording: Recording, poses: Float, p_static: Float32) -> Beams:
    """The returns of every few scans."""
    T_map_sensor = recording.T_map_sensor(poses)
    every = max(1, recording.n_beams // _MAX_SAMPLE)
    sampled = np.zeros(recording.n_beams, np.bool_)
    for scan in range(0, recording.n_scans, every):
        sampled[recording.beams_of(scan)] = True
    beams = np.flatnonzero(sampled & recording.hit)
    origins = T_map_sensor[recording.scans_of(beams), :2, 2]
    ends = recording.end_points(beams, poses)
    return Beams(origins, ends, p_static[beams] > 0.5, T_map_sensor[:, :2, 2])


def _find_on_line(
    beams: Beams, surfaces: SurfaceCells, normal: Float, distance: float
) -> Iterator[Mirror]:
    """Mirrors on a line, seen from where its normal points to."""
    front, behind = beams.origins @ normal - distance, distance - beams.ends @ normal
    met = np.flatnonzero((front > 0.0) & (behind > MIN_BEHIND))
    if len(met) < MIN_BEAMS:
        return
    origins, ends = beams.origins[met], beams.ends[met]
    share = front[met] / (front + behind)[met]
    along = (origins + share[:, None] * (ends - origins)) @ tangent_of(normal)
    some = ends[:: max(1, len(ends) // _MAX_TRIED)]
    counts = [surfaces.are_in(reflect(some, normal, distance + o)).sum() for o in _OFFSETS]
    distance += _OFFSETS[int(np.argmax(counts))]
    fit = surfaces.are_near(reflect(ends, normal, distance))
    crossing = CrossingBeams(origins, ends, along, fit)
    for first, last in _find_runs(along, fit):
        mirror = check_mirror(Mirror(normal, distance, first, last), crossing, beams, surfaces)
        if mirror is not None:
            yield mirror


def _find_runs(along: Float, fit: Bool) -> list[tuple[float, float]]:
    """Pieces of a line whose crossing beams fit, from first to last metre."""
    low = float(along.min())
    number = ((along - low) / BIN).astype(np.int64)
    total = np.bincount(number, minlength=1).astype(np.float64)
    fitting = np.bincount(number, weights=fit, minlength=1).astype(np.float64)
    around = np.ones(3)
    n = np.convolve(total, around, "same")
    fitting = np.convolve(fitting, around, "same")
    good = (n >= _MIN_BEAMS_PER_BIN) & (fitting >= _MIN_BIN_SHARE * n)
    runs: list[list[float]] = []
    for k in np.flatnonzero(good).tolist():
        start = low + BIN * k
        last_bin = round((runs[-1][1] - low) / BIN) if runs else 0
        gap = slice(last_bin, k)  # what stands before a mirror hides parts of it
        fits = fitting[gap].sum() >= _MIN_GAP_SHARE * n[gap].sum()
        if runs and k - last_bin <= _MAX_GAP / BIN and fits:
            runs[-1][1] = start + BIN
        else:
            runs.append([start, start + BIN])
    return [(a, b) for a, b in runs if b - a >= _MIN_WIDTH]
