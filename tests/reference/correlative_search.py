"""Correlative search by brute force: the score of every pose of a lattice around the prior."""

from dataclasses import dataclass
from itertools import product
from math import ceil, log

import numpy as np
from numpy.typing import NDArray

from reference.likelihood_field import retract
from reference.ray_traversal import cell_of

Float = NDArray[np.float64]
Int = NDArray[np.int64]

STEPS = 255  # of the values of a raster, and of the weights of beams


@dataclass(frozen=True)
class Raster:
    """ln((floor + F) / floor) in whole steps, F being the largest contribution of a single cell.

    Attributes:
        first: (2,) pixel of the lowest corner; zero outside the box.
        values: in steps, indexed [x, y].
        unit: nats of a step.
    """

    first: Int
    values: Int
    unit: float

    def at(self, pixels):
        """(...) values of pixels (..., 2)."""
        index = pixels - self.first
        inside = np.asarray(((index >= 0) & (index < self.values.shape)).all(axis=-1))
        found = self.values[tuple(np.moveaxis(np.where(inside[..., None], index, 0), -1, 0))]
        return np.where(inside, found, 0)


def raster(grid, cells, sigma, floor):
    """The raster of a map in pixels `cells` wide.

    A cell k contributes m_k exp(-|d|^2 / (2 s^2)), d between the centres of cell and pixel and
    s = 1.5 sigma or one pixel, whichever is larger; along no axis farther than 2 s. F is rounded
    to steps as well.
    """
    pixel = cells * grid.resolution
    wide = max(1.5 * sigma, pixel)
    reach = ceil(2.0 * wide / pixel)
    unit = log((floor + 1.0) / floor) / STEPS
    hit = [cell for cell, alpha in grid.alpha.items() if alpha > 0]
    if not hit:
        return Raster(np.zeros(2, np.int64), np.zeros((1, 1), np.int64), unit)
    own = np.array(hit, np.int64)
    m = np.array([grid.occupancy_of(cell) for cell in hit])
    pixels = own // cells
    first = pixels.min(axis=0) - reach
    F = np.zeros(pixels.max(axis=0) + reach + 1 - first)
    for step in product(range(-reach, reach + 1), repeat=2):
        d = (pixels + step + 0.5) * pixel - (own + 0.5) * grid.resolution
        g = m * np.exp(-0.5 * (d**2).sum(axis=1) / wide**2)
        np.maximum.at(F, tuple((pixels + step - first).T), g)
    F = np.floor(STEPS * F + 0.5) / STEPS
    return Raster(first, np.floor(np.log((floor + F) / floor) / unit + 0.5).astype(np.int64), unit)


@dataclass(frozen=True)
class Lattice:
    """Scores of a scan on a lattice of poses.

    Attributes:
        T_prior: (3, 3) pose of the centre.
        step: metres between poses along each axis.
        angle_step: radians between headings.
        scores: nats, more is better; indexed [heading, x, y].
    """

    T_prior: Float
    step: float
    angle_step: float
    scores: Float

    def index_of(self, T):
        """How far a pose (3, 3) is from the nearest one of the lattice, in steps; its index."""
        pose = np.asarray(T, float)
        turn = pose[:2, :2] @ self.T_prior[:2, :2].T
        theta = np.arctan2(turn[1, 0], turn[0, 0]) / self.angle_step
        place = np.array([theta, *((pose - self.T_prior)[:2, 2] / self.step)])
        nearest = np.round(place)
        middle = np.array(self.scores.shape) // 2
        return place - nearest, tuple((nearest + middle).astype(int))


def search_lattice(
    grid,
    points,
    weights,
    T_prior,
    information,
    *,
    sigma,
    floor,
    information_scale,
    window_translation,
    window_rotation,
    search_range,
):
    """The score of every pose in a window around the prior.

    information_scale sum_n w_n r(pixel of T p_n) - 1/2 d^T Lambda d, with the raster r and the
    difference d to the prior. Steps are a cell, or two where the window is wider than four, and
    the angle by which three quarters of the beams, or more, move less than a step, but not above
    0.035 rad.

    Args:
        grid: the map.
        points: (N, 2) metres, moving frame; at least one of them within `search_range`.
        weights: (N,) in [0, 1]; beams of weight 0 are left out.
        T_prior: (3, 3).
        information: (3, 3): Lambda of translation and rotation.
        sigma: metres.
        floor: as `registration_cost` has it.
        information_scale: weight of one beam against the prior.
        window_translation: metres, half width along each axis.
        window_rotation: radians, half width.
        search_range: metres, beams beyond are left out.
    """
    T, Lambda = np.asarray(T_prior, float), np.asarray(information, float)
    p, w = np.asarray(points, float), np.asarray(weights, float)
    used = (w > 0) & (np.linalg.norm(p, axis=1) <= search_range)
    p, w = p[used], np.floor(STEPS * w[used] + 0.5) / STEPS
    cells = 2 if window_translation > 4 * grid.resolution else 1
    step = cells * grid.resolution
    far = np.sort(np.linalg.norm(p, axis=1))[(len(p) - 1) * 3 // 4]
    angle_step = min(step / max(far, step), 0.035)
    S, A = ceil(window_translation / step), ceil(window_rotation / angle_step)
    shifts = np.array(list(product(range(-S, S + 1), repeat=2)))
    field, scores = raster(grid, cells, sigma, floor), []
    for a in range(-A, A + 1):
        d = np.zeros((len(shifts), 3))
        d[:, :2], d[:, 2] = shifts * step, a * angle_step
        turned = retract(T, np.array([0.0, 0.0, a * angle_step]))
        pixels = cell_of(p @ turned[:2, :2].T + turned[:2, 2], step)
        fit = np.array([field.at(pixels + shift) @ w for shift in shifts])
        penalty = 0.5 * np.einsum("ni,ij,nj->n", d, Lambda, d)
        scores.append(information_scale * field.unit * fit - penalty)
    shape = 2 * A + 1, 2 * S + 1, 2 * S + 1
    return Lattice(T, step, angle_step, np.array(scores).reshape(shape))
