"""Likelihood field of scan registration: the practical form of (9)."""

from itertools import product
from math import erf, exp, isnan, log, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from reference.ray_traversal import cell_of

Float = NDArray[np.float64]


def smoothed_occupancy(grid, y, sigma, radius):
    """F(y): smoothed occupancy at a point, about 1 on a straight, fully occupied wall.

    The sum over cells k within `radius` cells of that of y (largest coordinate difference) of
    m_k exp(-|y - mu_k|^2 / (2 sigma^2)), with mu_k the mean of the end points in cell k weighted
    with e, divided by sqrt(2 pi) sigma / resolution. In unobserved cells whose
    neighbouring means lie on a line, the surface is extrapolated: the mean of the m_k
    times exp(-d^2 / (2 sigma^2)) at a distance d from it.

    Args:
        grid: the map.
        y: (2,) metres, map frame.
        sigma: metres.
        radius: cells.
    """
    point = np.asarray(y, float)
    centre = cell_of(point, grid.resolution)
    means, m = _around(grid, centre, radius)
    if isnan(grid.occupancy_of(tuple(centre.tolist()))) and len(m) >= 2:
        mean, normal, is_flat = _line(means, m)
        if is_flat:
            return float(m.mean() * exp(-((normal @ (mean - point)) ** 2) / (2 * sigma**2)))
    total = 0.0
    for mu, m_k in zip(means, m, strict=True):
        away = point - mu
        total += m_k * exp(-float(away @ away) / (2 * sigma**2))
    return total / (sqrt(2 * pi) * sigma / grid.resolution)


def _around(grid, centre, radius):
    """Means (K, 2) of the end points in the neighbouring cells, and their occupancies (K,)."""
    means, m = [], []
    for step in product(range(-radius, radius + 1), repeat=2):
        cell = tuple((centre + step).tolist())
        alpha = grid.alpha.get(cell, 0.0)
        if alpha > 0:
            means.append(grid.moment[cell] / alpha)
            m.append(grid.occupancy_of(cell))
    return np.array(means).reshape(-1, 2), np.array(m)


def _line(means, m):
    """Centroid (2,) and normal (2,) of weighted points, and whether they lie on a line."""
    weights = m / m.sum()
    mean = weights @ means
    apart = means - mean
    variance, axes = np.linalg.eigh((weights[:, None] * apart).T @ apart)
    return mean, axes[:, 0], bool(variance[0] < 0.1 * variance[1])


def registration_cost(grid, points, weights, T, sigma, radius, floor, unknown):
    """- sum of w_n ln(floor + unknown U(T p_n) + F(T p_n)) over the points that are finite.

    U is 1 in unobserved cells, 0 elsewhere.

    Args:
        grid: the map.
        points: (N, 2) metres, sensor frame.
        weights: (N,).
        T: (3, 3) T_map_sensor.
        sigma: metres.
        radius: cells.
        floor: value of an end point in free space, where a wall has 1.
        unknown: added to floor in unobserved cells.
    """
    pose = np.asarray(T, float)
    cost = 0.0
    beams = zip(np.asarray(points, float), np.asarray(weights, float), strict=True)
    for p, w in beams:
        if np.isfinite(p).all():
            y = pose[:2, :2] @ p + pose[:2, 2]
            F = smoothed_occupancy(grid, y, sigma, radius)
            cost -= w * log(_base(grid, y, floor, unknown) + F)
    return float(cost)


def _base(grid, y, floor, unknown):
    unseen = isnan(grid.occupancy_of(tuple(cell_of(y, grid.resolution).tolist())))
    return floor + (unknown if unseen else 0.0)


def registration_gradient(grid, points, weights, T, sigma, radius, floor, unknown, step=1e-06):
    """Gradient of `registration_cost` by central differences.

    Returns:
        (3,) with respect to x, y, theta: metres and radians along the axes of the map, the sensor
        turning about its own position.
    """
    pose = np.asarray(T, float)
    gradient = []
    for delta in step * np.eye(3):
        above, below = (
            registration_cost(
                grid, points, weights, retract(pose, d), sigma, radius, floor, unknown
            )
            for d in (delta, -delta)
        )
        gradient.append((above - below) / (2 * step))
    return np.array(gradient)


def registration_curvature(grid, points, weights, T, sigma, radius, floor, unknown):
    """Approximate Hessian of `registration_cost` used by the Newton steps.

    The sum of w_n s_n J_n^T A_n J_n: s = F / (base + F) is the inlier probability of a
    beam, J the derivative of T p_n by the pose, and A the curvature of -ln F, see
    `_curvature`.

    Returns:
        (3, 3), order and units as the gradient's.
    """
    pose = np.asarray(T, float)
    H = np.zeros((3, 3))
    for p, w in zip(np.asarray(points, float), np.asarray(weights, float), strict=True):
        if np.isfinite(p).all():
            y = pose[:2, :2] @ p + pose[:2, 2]
            F = smoothed_occupancy(grid, y, sigma, radius)
            arm = y - pose[:2, 2]
            J = np.array([[1.0, 0.0, -arm[1]], [0.0, 1.0, arm[0]]])
            explained = F / (_base(grid, y, floor, unknown) + F)
            if F > 0:
                H += w * explained * J.T @ _curvature(grid, y, sigma, radius) @ J
    return H


def _curvature(grid, y, sigma, radius):
    """(2, 2) sigma^-2 I - sigma^-4 C / v without its negative part.

    C is the spread of the means mu_k around y, each weighted with its part of F, and v the
    variance that is left to a Gaussian of variance 1 cut off where the sum ends. Where a
    surface is extrapolated, sigma^-2 across it and nothing along it.
    """
    centre = cell_of(y, grid.resolution)
    means, m = _around(grid, centre, radius)
    if isnan(grid.occupancy_of(tuple(centre.tolist()))) and len(m) >= 2:
        _, normal, is_flat = _line(means, m)
        if is_flat:
            return np.outer(normal, normal) / sigma**2
    parts = m * np.exp(-((y - means) ** 2).sum(axis=1) / (2 * sigma**2))
    apart = means - parts @ means / parts.sum()
    spread = (parts[:, None] * apart).T @ apart / parts.sum()
    cut = (radius + 0.5) * grid.resolution / sigma
    v = 1.0 - sqrt(2 / pi) * cut * exp(-(cut**2) / 2) / erf(cut / sqrt(2))
    values, axes = np.linalg.eigh(np.eye(2) / sigma**2 - spread / (v * sigma**4))
    kept: Float = axes @ np.diag(np.maximum(values, 0.0)) @ axes.T
    return kept


def retract(T, delta):
    """T_map_sensor (3, 3) shifted by delta[:2] and turned by delta[2] about its own position."""
    out, turn = T.copy(), delta[2]
    out[:2, 2] += delta[:2]
    out[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]] @ T[:2, :2]
    return out
