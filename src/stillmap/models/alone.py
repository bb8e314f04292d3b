"""Whether what was followed moved: what ended there was dynamic, not some of it only.

Of what stands still, as a hedge or the edge of a wall, some beams are now and then taken for
dynamic, and followed; others ended right beside them, at the same time, on what is static.
"""

import numpy as np
from scipy.spatial import cKDTree

from stillmap.models.frames import Way
from stillmap.models.own import scans_about, seconds_of
from stillmap.models.sources import Sources
from stillmap.surface.dividing import divided
from stillmap.surface.mesh import Mesh

_GROUND = 0.1  # m above the foot of a thing, up to where beams may have met the ground
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
        NaN where no beam ended there, 0.1 m above its foot or higher.
    """
    seen = sources.seen
    fine, _ = divided(mesh, _FINE * reach)
    tree = cKDTree(fine.vertices)
    low, high = fine.vertices.min(axis=0) - reach, fine.vertices.max(axis=0) + reach
    low[2] = max(low[2], _GROUND)
    total, count = 0.0, 0
    scans = scans_about(*span, sources)
    for scan in range(scans.start, scans.stop):  # all of a second's would be too many at once
        beams = np.arange(seen.offset[scan], seen.offset[scan + 1])
        seconds = seconds_of(beams, sources)
        then = (seconds >= span[0]) & (seconds <= span[1]) & seen.hit[beams]
        beams, seconds = beams[then], seconds[then]
        at = way.local(seconds, seen.end_points(beams, sources.poses))
        some = np.flatnonzero(((at > low) & (at < high)).all(axis=1))
        off = tree.query(at[some], distance_upper_bound=reach)[0]
        near = sources.p_static[beams[some[np.isfinite(off)]]]
        total += float(near.sum(dtype=np.float64))
        count += len(near)
    return 1.0 - total / count if count else float("nan")
