"""Causal E-step in 3D: cells are looked up in the range image of each sweep."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reference.beam_counting import usable_beams
from reference.occupancy_filter import MAX_PASSES, OccupancyFilter, Passed

Float = NDArray[np.float64]

RELIABILITY, MIN_RELIABILITY, MARGIN = 0.9, 0.1, 1.5
PI = np.float32(3.14159265)


def arctan2(y, x):
    """Abramowitz and Stegun, 4.4.49, in single precision: binned as by the kernel."""
    x, y = np.float32(x), np.float32(y)
    ax, ay = np.abs(x), np.abs(y)
    a = np.minimum(ax, ay) / np.maximum(np.maximum(ax, ay), np.float32(1e-30))
    s = a * a
    angle = np.zeros_like(a)
    for c in (0.0208351, -0.0851330, 0.1801410, -0.3302995, 0.9998660):
        angle = np.float32(c) + s * angle
    angle = a * angle
    angle = np.where(ay > ax, np.float32(0.5) * PI - angle, angle)
    angle = np.where(x < 0.0, PI - angle, angle)
    return np.where(y < 0.0, -angle, angle)


class RangeImage:
    """The shortest range in each pixel and around it; empty pixels: 0."""

    def __init__(self, points, pixel):
        self.azimuth, self.elevation = np.float32(pixel[0]), np.float32(pixel[1])
        self.columns = int(np.ceil(np.float32(2.0) * PI / self.azimuth))
        up = self._elevation(points)
        self.lowest = up.min(initial=np.float32(PI))
        row, column = self._pixels(points)
        image = np.full((row.max(initial=-1) + 1, self.columns), np.inf)
        np.minimum.at(image, (row, column), np.linalg.norm(points, axis=1))
        self.free = np.zeros_like(image)
        for r, c in np.argwhere(np.isfinite(image)):
            rows = slice(max(r - 1, 0), r + 2)
            self.free[r, c] = min(image[rows, (c + k) % self.columns].min() for k in (-1, 0, 1))

    def _elevation(self, points):
        x, y, z = np.float32(points).T
        return arctan2(z, np.sqrt(x * x + y * y))

    def _pixels(self, points):
        x, y, _ = np.float32(points).T
        row = np.floor((self._elevation(points) - self.lowest) / self.elevation).astype(int)
        column = ((arctan2(y, x) + PI) / self.azimuth).astype(int)
        return row, np.clip(column, 0, self.columns - 1)

    def free_range(self, point):
        row, column = (int(a[0]) for a in self._pixels(point[None]))
        return float(self.free[row, column]) if 0 <= row < len(self.free) else 0.0


@dataclass
class View:
    """What a sweep saw from where."""

    T_map_sensor: Float
    image: RangeImage
    time_bin: int


class SweepFilter3D(OccupancyFilter):
    """See the kernel."""

    def __init__(self, resolution, **options):
        super().__init__(resolution, **options)
        self.views: list[View] = []
        self.known_free = set[tuple[int, ...]]()

    def prime(self, cells, occupied, log_ratio):
        for cell, is_occupied in zip(map(tuple, cells.tolist()), occupied, strict=True):
            if cell in self.filters and not is_occupied:
                continue
            if not is_occupied:
                self.known_free.add(cell)
                continue
            if cell not in self.filters:
                self.filters[cell], self.passed[cell] = self._new_filter([], -1, 0), Passed()
            one = self.filters[cell]
            one.log_likelihood[self.n_static :] -= log_ratio
            one.log_likelihood = self._normalize(one.log_likelihood)

    def add(self, points, hit, offset, T_map_sensor, *, pixel, time_bin, tag):
        beams = [b for b in usable_beams(3, points, hit, offset, T_map_sensor) if b.hit]
        ends = np.array([points[b.number] for b in beams], np.float64).reshape(-1, 3)
        view = View(T_map_sensor[0], RangeImage(ends, pixel), time_bin)
        for cell, one in self.filters.items():
            reliability = self._visibility(view, cell)
            if reliability < MIN_RELIABILITY:
                continue
            if self._open(one, time_bin) and not one.hit:
                one.p_missed *= 1.0 - reliability
        first = {}
        for beam in beams:
            end = beam.end / self.resolution
            cell = tuple(np.floor(end).astype(int).tolist())
            first.setdefault(cell, end)
            if cell not in self.filters:
                self.filters[cell] = self._after_views(cell, tag)
                self.passed[cell] = Passed()
        for end in first.values():
            self._hit(end, time_bin, tag)
        if not self.views or self.views[-1].time_bin < time_bin:
            self.views = [*self.views, view][-MAX_PASSES:]

    def _after_views(self, cell, tag):
        if cell in self.known_free:
            return self._new_filter([RELIABILITY] * MAX_PASSES, -1, tag)
        passes = [(self._visibility(view, cell), view.time_bin) for view in self.views]
        passes = [(r, time_bin) for r, time_bin in passes if r >= MIN_RELIABILITY]
        last = passes[-1][1] if passes else -1
        return self._new_filter([r for r, _ in passes], last, tag)

    def _visibility(self, view, cell):
        """P(the beams of a view met the surface of a cell if it stood there)."""
        T, edge = view.T_map_sensor, self.resolution
        p = T[:3, :3].T @ ((np.array(cell) + 0.5) * edge - T[:3, 3])
        distance = float(np.linalg.norm(p))
        if distance + MARGIN * edge >= view.image.free_range(p):
            return 0.0
        image = view.image
        across = min(1.0, edge / (distance * float(image.azimuth)))
        return RELIABILITY * across * min(1.0, edge / (distance * float(image.elevation)))
