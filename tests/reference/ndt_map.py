"""NDT map and point-to-plane registration of sweeps; see docs/poses.md."""

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2, se3

Float = NDArray[np.float64]


class NdtMap3D:
    """Weight, first and second moments of end points per voxel and level, about its centre."""

    def __init__(self, edge, levels, max_weight):
        self.edges = [edge * 2.0**level for level in range(levels)]
        self.max_weight = max_weight
        self.cells: list[dict[tuple[int, ...], list[Any]]] = [{} for _ in self.edges]

    def add(self, points, weights, T_map_base):
        for point, weight in zip(points.astype(float), weights.astype(float), strict=True):
            if not np.isfinite(point).all() or weight <= 0.0:
                continue
            y = T_map_base[:3, :3] @ point + T_map_base[:3, 3]
            for edge, cells in zip(self.edges, self.cells, strict=True):
                cell = np.floor(y / edge)
                sums = cells.setdefault(tuple(cell.astype(int)), [0.0, np.zeros(3), np.eye(3) * 0])
                if sums[0] < self.max_weight:
                    x = y / edge - (cell + 0.5)
                    sums[0] += weight
                    sums[1] += weight * x
                    sums[2] += weight * np.outer(x, x)

    def crop(self, T_map_base, radius):
        for level, edge in enumerate(self.edges):
            self.cells[level] = {
                cell: sums
                for cell, sums in self.cells[level].items()
                if np.linalg.norm((np.array(cell) + 0.5) * edge - T_map_base[:3, 3]) <= radius
            }

    def plane(self, place, level, min_weight, max_flatness, min_extent):
        """Normal, offset along it and variance across; None where there is no plane."""
        x = place / self.edges[level]
        low = np.floor(x - 0.5)
        within = x - 0.5 - low
        weight, first, second = 0.0, np.zeros(3), np.zeros((3, 3))
        for corner in itertools.product((0, 1), repeat=3):
            cell = low + corner
            share = np.prod(np.where(corner, within, 1.0 - within))
            sums = self.cells[level].get(tuple(cell.astype(int)))
            if sums is None:
                continue
            w, a, A = sums
            c = cell + 0.5 - x
            weight += share * w
            first += share * (a + w * c)
            second += share * (A + np.outer(c, a) + np.outer(a, c) + w * np.outer(c, c))
        if weight < min_weight:
            return None
        mean = first / weight
        variance, axes = np.linalg.eigh(second / weight - np.outer(mean, mean))
        if variance[1] < min_extent or variance[0] > max_flatness * variance[1]:
            return None
        edge = self.edges[level]
        return axes[:, 0], float(axes[:, 0] @ mean) * edge, max(variance[0], 0.0) * edge**2


def voxel_downsample(points, weights, voxel_size):
    """Indices of the first usable point of positive weight in each voxel."""
    usable = np.flatnonzero(np.isfinite(points).all(axis=1) & (weights > 0.0))
    cells = np.floor(points[usable].astype(float) / voxel_size)
    first = np.unique(cells, axis=0, return_index=True)[1]
    return usable[np.sort(first)].astype(np.int64)


def transform_by_twist(points, times, twist):
    """Exp(time twist) p of each point."""
    T = se3.exp(times.astype(float)[:, None] * twist)
    transformed: Float = np.einsum("nij,nj->ni", T[:, :3, :3], points.astype(float)) + T[:, :3, 3]
    return transformed


@dataclass
class QuadraticModel:
    """Quadratic model of the data term at one state."""

    hessian: Float
    gradient: Float
    cost: float = 0.0
    inlier_weight: float = 0.0
    matched_weight: float = 0.0
    total_weight: float = 0.0


def linearise_sweep(
    map,
    points,
    weights,
    times,
    T,
    twist,
    *,
    min_weight,
    max_flatness,
    min_extent,
    range_std,
    kernel_width,
    level,
    slack,
):
    """The objective of docs/poses.md, beam by beam."""
    q = QuadraticModel(np.zeros((12, 12)), np.zeros(12))
    still = transform_by_twist(points, times, twist)
    for p, e, tau in zip(still, weights.astype(float), times.astype(float), strict=True):
        if not np.isfinite(p).all() or e <= 0.0:
            continue
        q.total_weight += e
        y = T[:3, :3] @ p + T[:3, 3]
        levels = range(level, len(map.edges))
        planes = (map.plane(y, at, min_weight, max_flatness, min_extent) for at in levels)
        plane = next((found for found in planes if found is not None), None)
        if plane is None:
            continue
        normal, offset, variance = plane
        v = variance + range_std**2 + slack**2
        s = offset**2 / v
        w = e / (1.0 + s / kernel_width**2) ** 2 / v
        n = T[:3, :3].T @ normal
        row = np.concatenate([n, np.cross(p, n)])
        row = np.concatenate([row, tau * row])
        q.hessian += w * np.outer(row, row)
        q.gradient += -w * offset * row
        q.cost += 0.5 * e * s / (1.0 + s / kernel_width**2)
        q.matched_weight += e
        q.inlier_weight += e * (s < kernel_width**2)
    return q


def register_sweep(
    map,
    points,
    weights,
    times,
    T_prior,
    twist_prior,
    information,
    *,
    information_scale,
    start_level,
    start_slack,
    max_iterations,
    tolerance,
    **options,
):
    """Pose, twist and covariance after Gauss-Newton steps from the prior."""
    T, twist = T_prior.copy(), twist_prior.copy()
    level, slack, steps = start_level, start_slack, 0
    while True:
        q = linearise_sweep(
            map, points, weights, times, T, twist, level=level, slack=slack, **options
        )
        H = information_scale * q.hessian + information
        if steps == max_iterations:
            break
        apart = se2.inverse(T_prior) @ T
        d = np.concatenate([apart[:3, 3], se3.log_rotation(apart[:3, :3]), twist - twist_prior])
        step = -np.linalg.solve(H, information_scale * q.gradient + information @ d)
        T[:3, 3] += T[:3, :3] @ step[:3]
        T[:3, :3] = T[:3, :3] @ se3.exp(np.concatenate([np.zeros(3), step[3:6]]))[:3, :3]
        twist = twist + step[6:]
        steps += 1
        small = np.linalg.norm(step[:3]) < tolerance
        small &= np.linalg.norm(step[3:6]) < 0.1 * tolerance
        if level == 0 and slack == 0.0 and small:
            break
        level = max(level - 1, 0)
        slack = 0.5 * slack if slack > options["range_std"] else 0.0
    covariance: Float = np.linalg.inv(H).astype(np.float64)
    return T, twist, covariance
