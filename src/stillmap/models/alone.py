"""Whether what was followed moved: what ended there was dynamic, not some of it only.

Of what stands still, as a hedge or the edge of a wall, some beams are now and then taken for
dynamic, and followed; others ended right beside them, at the same time, on what is static.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stillmap.models.frames import Way
from stillmap.models.own import scans_about, seconds_of
from stillmap.models.sources import Sources
from stillmap.surface.dividing import divided
from stillmap.surface.mesh import Mesh

_GROUND = 0.1  # m, how rough it is
_FINE = 0.5  # of the distance that counts, between points of the surface


def p_dynamic_at(
    mesh: Mesh, way: Way, span: tuple[float, float], sources: Sources, reach: float
) -> float:
    """Mean P(c = 0) of the beams that ended at a thing when it was seen, but for the ground's.

    Args:
        mesh: its surface, in its own frame.
        way: where that frame was.
        span: s, from when to when it was seen.
        sources: the beams.
        reach: metres from its surface.

    Returns:
        NaN where all ended on the ground.
    """
    scans, offset = scans_about(*span, sources), sources.seen.offset
    beams = np.arange(offset[scans.start], offset[scans.stop])
    seconds = seconds_of(beams, sources)
    then = (seconds >= span[0]) & (seconds <= span[1]) & sources.seen.hit[beams]
    beams, seconds = beams[then], seconds[then]
    at = way.local(seconds, sources.seen.end_points(beams, sources.poses))
    near = _within(at, mesh, reach)
    p_static = sources.p_static[beams[near]].astype(np.float64)
    return float(1.0 - p_static.mean()) if len(p_static) else float("nan")


def _within(points: NDArray[np.float64], mesh: Mesh, reach: float) -> NDArray[np.intp]:
    """Which of points (n, 3) lie that near to a surface, and above the ground."""
    low, high = mesh.vertices.min(axis=0) - reach, mesh.vertices.max(axis=0) + reach
    low[2] = max(low[2], _GROUND)
    some = np.flatnonzero(((points > low) & (points < high)).all(axis=1))
    fine, _ = divided(mesh, max(_FINE * reach, 0.01))
    off = cKDTree(fine.vertices).query(points[some], distance_upper_bound=reach)[0]
    return some[np.isfinite(off)]
