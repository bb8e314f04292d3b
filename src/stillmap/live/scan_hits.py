"""The hits of a scan as registration and labels take them."""

import numpy as np
from numpy.typing import NDArray

from stillmap.live.scan import ScanBeams
from stillmap.slam import scan_hits

Float = NDArray[np.float64]

_MAX_REGISTERED = 600  # end points of a scan that are registered


def select_hits(beams: ScanBeams) -> scan_hits.Scan:
    """The hits of a scan in the base frame with weight 1, and the normals of their surfaces."""
    points = scan_hits.transform_points(beams.points[beams.hit], beams.T_base_sensor)
    return scan_hits.make_scan(points, np.ones(len(points), np.float32), beams.T_base_sensor)


def thin(hits: scan_hits.Scan) -> scan_hits.Scan:
    """Hits for registration: more than so many say no more."""
    every = slice(None, None, max(-(-len(hits.points) // _MAX_REGISTERED), 1))
    points, weights, normals, isotropy = (
        np.ascontiguousarray(a[every])
        for a in (hits.points, hits.weights, hits.normals, hits.isotropy)
    )
    return scan_hits.Scan(points, weights, hits.T_base_sensor, normals, isotropy)


def normals_of(beams: ScanBeams, hits: scan_hits.Scan) -> Float:
    """(N, D) normals in the sensor frame; 0 where nothing was hit."""
    out = np.zeros(beams.points.shape)
    out[beams.hit] = hits.normals @ beams.T_base_sensor[:2, :2]  # rotated back
    return out
