"""Observations of surfels by the beams of one time bin: hits, and misses of some reliability."""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from reference.no_return_beams import beams_in_runs
from reference.ray_traversal import cell_of, traverse

HIT = -1.0  # instead of the reliability of a miss
SURE = 0.95  # crossing probabilities above are 1
MIN_RELIABILITY = 0.02  # crossing probabilities below are no observation
SOLID = 10  # returns of a solid planar surfel, at least


@dataclass(frozen=True)
class MeasurementModel:
    """How beams observe surfels; lengths in metres.

    Attributes:
        lateral_std: standard deviation of the lateral position of a beam.
        margin: a beam misses a surfel if it ends at least this far behind it.
        hit_radius: surfels with means within this distance of a hit surfel are hit as well.
        end_margin: length before the end of a maximum-range beam that is not trusted.
        use_normals: whether planar surfels are discs; else all surfels are spheres.
        trust: trust in beams without a return beyond the first solid surfel, from 0 to 1.
    """

    lateral_std: float
    margin: float
    hit_radius: float
    end_margin: float
    use_normals: bool = True
    trust: float = 1.0

    def __post_init__(self):
        for name in ("lateral_std", "margin", "hit_radius", "end_margin"):
            if not 0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name}: expected a positive length")


def observe(surfel_map, beams, model):
    """Observations of surfels in one time bin: HIT, or the reliability of a miss.

    A surfel is hit where a beam ends in its cell or within `hit_radius` of a surfel in whose cell
    a beam ends. Other surfels whose cells are crossed are missed with reliability R = 1 - the
    product over these beams of 1 - P(crossing). Beams without a return count in runs only, and
    are trusted less from the first solid surfel on.
    """
    index = surfel_map.index_of_cell()
    not_crossed: dict[int, float] = {}
    ended_on = set()
    trusted = beams_in_runs(beams)
    for beam in beams:
        if not beam.hit and beam.number not in trusted:
            continue
        trust = 1.0
        for k, p in crossed_surfels(surfel_map, index, beam, model):
            if not beam.hit and is_solid(surfel_map.fitted[k], model):
                trust = model.trust
            not_crossed[k] = not_crossed.get(k, 1.0) * (1.0 - trust * p)
        end = index.get(tuple(cell_of(beam.end, surfel_map.resolution).tolist()))
        if beam.hit and end is not None:
            ended_on.add(end)
    means = np.array([surfel.mean for surfel in surfel_map.fitted])
    hit: set[int] = set()
    for k in ended_on:
        distance = np.linalg.norm(means - means[k], axis=1)
        hit.update(np.flatnonzero(distance <= model.hit_radius).tolist())
    reliability = {k: 1.0 - q for k, q in not_crossed.items() if 1.0 - q > MIN_RELIABILITY}
    misses = {k: 1.0 if p > SURE else p for k, p in reliability.items()}
    return misses | dict.fromkeys(hit, HIT)


def is_solid(surfel, model):
    """Whether a surfel is planar and has many returns."""
    return model.use_normals and surfel.plane is not None and surfel.beams >= SOLID


def crossed_surfels(surfel_map, index, beam, model):
    """(surfel, P(crossing)) of all surfels whose cells the beam crosses before its end."""
    way = beam.end - beam.start
    length = float(np.linalg.norm(way))
    usable = length if beam.hit else length - model.end_margin
    if usable <= 0:
        return []
    end = beam.start + way * (usable / length)
    cells, _ = traverse(beam.start, end, surfel_map.resolution)
    crossed = [index.get(tuple(cell)) for cell in cells[:-1].tolist()]
    return_point = beam.end if beam.hit else None
    line = 0.5 * surfel_map.resolution, beam.start, way / length, return_point, model
    return [(k, _p_crossing(surfel_map.fitted[k], *line)) for k in crossed if k is not None]


def _p_crossing(surfel, sphere_radius, start, direction, end, model):
    """P(a beam crosses the surfel within its extent), with Gaussian lateral noise.

    `end` is the end point of a return; surfels that are not planar are spheres. A disc seen at an
    angle has the apparent half width |n . d| times its own. A return less than `margin` behind
    the surfel may come from it: no crossing.
    """
    plane = surfel.plane if model.use_normals else None
    if end is not None:
        behind = end - (plane.centre if plane else surfel.mean)
        distance = abs(plane.normal @ behind) if plane else np.linalg.norm(behind)
        if distance < model.margin:
            return 0.0
    offset = (plane.centre if plane else surfel.mean) - start
    lateral = float(np.linalg.norm(offset - (offset @ direction) * direction))
    half = plane.half * abs(float(plane.normal @ direction)) if plane else sphere_radius
    p = ndtr((half - lateral) / model.lateral_std) - ndtr((-half - lateral) / model.lateral_std)
    return float(p)


def view_angle_between(before, now, position, resolution):
    """Change of the line of sight to a position (D,): robot displacement / distance, radians.

    Distances below a cell count as one cell.
    """
    displacement = float(np.linalg.norm(now - before))
    return displacement / max(resolution, float(np.linalg.norm(now - position)))
