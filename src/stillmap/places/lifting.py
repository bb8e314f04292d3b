"""From an alignment in the plane to poses in D dimensions."""

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se3
from stillmap.places.place import Place
from stillmap.places.placement import Placement
from stillmap.places.session import Session

Float = NDArray[np.float64]

_MIN_NODES, _MIN_SPREAD = 8, 5.0  # nodes, and their spread in m, from which on tilt is estimated
_MAX_TILT = 0.1  # rad
_REACH = 20.0  # m between nodes at which the ground is the same


def lift_alignment(place: Place, session: Session, found: Placement) -> Float:
    """(N, D+1, D+1) poses of a session's nodes in the place, by an alignment in the plane.

    In 3D, height and tilt are those at which the ground lies as the place knows it: the base of
    two keyframes near each other is as high above it as each was.
    """
    if session.dimension == 2:
        return found.T @ session.node_poses
    T = np.eye(4)
    T[:2, :2], T[:2, 3] = found.T[:2, :2], found.T[:2, 2]
    nodes = T @ session.node_poses
    clearance = session.clearance[session.keyframes.nodes]
    at, rise = [np.zeros((0, 3))], [np.zeros(0)]
    for other in place.sessions:
        theirs, their_clearance = other.nodes, other.session.clearance
        distance = np.linalg.norm(nodes[:, None, :2, 3] - theirs[None, :, :2, 3], axis=2)
        nearest = distance.argmin(axis=1)
        near = np.flatnonzero(distance.min(axis=1) <= _REACH)
        of = nearest[near]
        ground = theirs[of, 2, 3] - their_clearance[other.session.keyframes.nodes[of]]
        at.append(nodes[near, :3, 3])
        rise.append(ground + clearance[near] - nodes[near, 2, 3])
    return _tilt(np.concatenate(at), np.concatenate(rise)) @ nodes


def _tilt(at: Float, rise: Float) -> Float:
    """(4, 4) small motion that lifts points (n, 3) by (n,) metres, robustly."""
    if not len(at):
        return np.eye(4)
    centre, height = at.mean(axis=0), float(np.median(rise))
    offset = at[:, :2] - centre[:2]
    slope = np.zeros(2)
    if len(at) >= _MIN_NODES and offset.std(axis=0).min() >= _MIN_SPREAD:
        kept = np.abs(rise - height) <= 3.0 * np.median(np.abs(rise - height)) + 1e-3
        fit = np.linalg.lstsq(
            np.column_stack([offset[kept], np.ones(int(kept.sum()))]), rise[kept], rcond=None
        )[0]
        slope, height = np.clip(fit[:2], -_MAX_TILT, _MAX_TILT), float(fit[2])
    to_centre = np.eye(4)
    to_centre[:3, 3] = centre
    back = np.eye(4)
    back[:3, 3] = -centre
    # a rotation vector (slope_y, -slope_x, 0) raises a point by its offset times the slope
    turn = se3.exp(np.array([0.0, 0.0, height, slope[1], -slope[0], 0.0]))
    out: Float = to_centre @ turn @ back
    return out
