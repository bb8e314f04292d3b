"""Normals of a planar scan, and what they say about its pose."""

import numpy as np


def estimate_normals(points, radius, max_gap, flat_below, round_from):
    """Normals (N, 2) and isotropy (N,) of the surfaces at end points (N, 2).

    The neighbors of an end point are the successive ones to either side that are within `radius`
    of it (the next one may be farther), as long as no gap exceeds `max_gap`. The normal is the
    direction of least variance among them; with fewer than two neighbors it is zero.

    Args:
        points: metres, in the order of the beams.
        radius, max_gap: metres.
        flat_below, round_from: ratios of the variances at which the isotropy is 0 and 1.
    """
    normals, isotropy = np.zeros((len(points), 2)), np.zeros(len(points))
    for n, point in enumerate(points):
        around = [n]
        for step in (-1, 1):
            k = n + step
            while 0 <= k < len(points):
                gap = np.linalg.norm(points[k] - points[k - step])
                is_next = k == n + step
                if gap > max_gap or (not is_next and np.linalg.norm(points[k] - point) > radius):
                    break
                around.append(k)
                k += step
        if len(around) < 3:
            continue
        apart = points[around] - points[around].mean(axis=0)
        (least, most), vectors = np.linalg.eigh(apart.T @ apart)
        normals[n] = vectors[:, 0]
        ratio = least / max(most, 1e-12)
        isotropy[n] = np.clip((ratio - flat_below) / (round_from - flat_below), 0.0, 1.0)
    return normals, isotropy


def surface_information(points, weights, normals, isotropy, pose):
    """Information (3, 3) about x, y, heading of weighted end points at a pose (3, 3)."""
    out = np.zeros((3, 3))
    R = pose[:2, :2]
    for point, weight, normal, s in zip(points, weights, normals, isotropy, strict=True):
        lever, n = R @ point, R @ normal
        J = np.array([[1.0, 0.0, -lever[1]], [0.0, 1.0, lever[0]]])
        out += weight * J.T @ ((1.0 - s) * np.outer(n, n) + s * np.eye(2)) @ J
    return out


def evidence_shares(points, correlation_length):
    """Shares (N,) of the evidence of end points (N, 2) that is not their neighbours', too."""
    gaps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    own = np.minimum(np.concatenate([[np.inf], gaps, [np.inf]]) / correlation_length, 1.0)
    return 0.5 * (own[:-1] + own[1:])
