"""A particle filter with a likelihood field, for comparison: model and parameters of nav2's AMCL.

Probabilistic Robotics, tables 5.6 (odometry motion model), 6.3 (likelihood field) and 8.2; the
number of particles is fixed.
"""

import numpy as np
from scipy import ndimage

from stillmap.core import se2

# defaults of nav2_amcl, but for the number of particles, which is its largest
PARTICLES = 2000
ALPHA = (0.2, 0.2, 0.2, 0.2)
Z_HIT, Z_RAND, SIGMA_HIT, MAX_DISTANCE = 0.5, 0.5, 0.2, 2.0
MAX_BEAMS, MAX_RANGE = 60, 100.0
MIN_TRAVEL, MIN_TURN = 0.25, 0.2  # m, rad between two updates
INITIAL_STD = 0.1, 0.1, 0.05


class ParticleFilter:
    """Poses in a known occupancy map, from a known start.

    Args:
        grid: `stillmap.results.reader.Grid`.
        start: (3, 3).
        rng: of the particles.
    """

    def __init__(self, grid, start, rng):
        distance = ndimage.distance_transform_edt(~grid.occupied) * grid.resolution
        self._field = np.minimum(distance, MAX_DISTANCE)
        self._grid, self._rng = grid, rng
        noise = rng.normal(size=(PARTICLES, 3)) * INITIAL_STD
        self._x = se2.parameters(start) + noise
        self._moved = np.eye(3)

    def push(self, points, hit, T_base_sensor, increment):
        """The mean pose (3, 3) after an odometry increment (3, 3) and a scan."""
        self._moved = self._moved @ increment
        step = se2.parameters(self._moved)
        if np.hypot(*step[:2]) >= MIN_TRAVEL or abs(step[2]) >= MIN_TURN:
            self._move(step)
            self._weigh(points[hit] @ T_base_sensor[:2, :2].T + T_base_sensor[:2, 2])
            self._moved = np.eye(3)
        mean = self._x.mean(axis=0)
        heading = np.arctan2(np.sin(self._x[:, 2]).mean(), np.cos(self._x[:, 2]).mean())
        return se2.matrix(mean[0], mean[1], heading) @ self._moved

    def _move(self, step):
        """The odometry motion model: rotation, translation, rotation, each with noise."""
        x, y, turn = step
        metres = np.hypot(x, y)
        first = np.arctan2(y, x) if metres > 0.01 else 0.0
        second = se2.wrap(turn - first)
        a1, a2, a3, a4 = ALPHA
        n, noise = len(self._x), self._rng.normal
        near = [min(abs(a), abs(se2.wrap(a + np.pi))) for a in (first, second)]
        r1 = first + noise(size=n) * np.sqrt(a1 * near[0] ** 2 + a2 * metres**2)
        r2 = second + noise(size=n) * np.sqrt(a1 * near[1] ** 2 + a2 * metres**2)
        spread = np.sqrt(a3 * metres**2 + a4 * (near[0] ** 2 + near[1] ** 2))
        way = metres + noise(size=n) * spread
        heading = self._x[:, 2] + r1
        self._x[:, 0] += way * np.cos(heading)
        self._x[:, 1] += way * np.sin(heading)
        self._x[:, 2] = se2.wrap(heading + r2)

    def _weigh(self, points):
        """The likelihood field model, and resampling by low variance."""
        if not len(points):
            return
        some = points[:: max(len(points) // MAX_BEAMS, 1)][:MAX_BEAMS]
        c, s = np.cos(self._x[:, 2])[:, None], np.sin(self._x[:, 2])[:, None]
        x = self._x[:, :1] + c * some[:, 0] - s * some[:, 1]
        y = self._x[:, 1:2] + s * some[:, 0] + c * some[:, 1]
        cells = self._grid.cells(np.stack([x, y], axis=-1).reshape(-1, 2))
        inside = ((cells >= 0) & (cells < self._field.shape)).all(axis=1)
        distance = np.full(len(cells), MAX_DISTANCE)
        distance[inside] = self._field[tuple(cells[inside].T)]
        p = Z_HIT * np.exp(-0.5 * (distance / SIGMA_HIT) ** 2) + Z_RAND / MAX_RANGE
        weights = 1.0 + (p.reshape(len(self._x), -1) ** 3).sum(axis=1)  # as AMCL combines beams
        weights /= weights.sum()
        at = (np.arange(len(weights)) + self._rng.random()) / len(weights)
        chosen = np.minimum(np.searchsorted(np.cumsum(weights), at), len(weights) - 1)
        self._x = self._x[chosen]
