"""What stands apart in a sweep is one body: what is known of its parts, on average."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reference.beams import usable_beams
from reference.surface import Surface
from reference.traverse import cell_of

Float = NDArray[np.float64]
Column = tuple[int, int]

LEVEL = 0.85  # cosine of the slope from which on a surface is no floor


class Bodies3D:
    """What sweeps say of the body around each element.

    Args:
        surface: E elements, in space.
        stands: (E,) of which of them bodies consist.
        values: (E, K) what is known of each.
        column: cells, edge of the columns over the ground that touch within a body.
        fewest: elements of a body at least.
    """

    def __init__(
        self,
        surface: Surface,
        stands: ArrayLike,
        values: ArrayLike,
        *,
        column: int,
        fewest: int,
    ) -> None:
        self.surface, self.column, self.fewest = surface, column, fewest
        self.stands = np.asarray(stands, bool)
        self.values = np.asarray(values, float)
        self.told: list[list[Float]] = [[] for _ in range(surface.size)]

    def add(
        self,
        points: ArrayLike,
        hit: ArrayLike,
        offset: ArrayLike,
        T_map_sensor: ArrayLike,
        threads: int = 1,  # noqa: ARG002  the core's signature
    ) -> None:
        """Each scan is a sweep."""
        number = self.surface.numbers()
        of_scan: dict[int, set[int]] = {}
        for beam in usable_beams(3, points, hit, offset, T_map_sensor):
            cell = tuple(cell_of(beam.end, self.surface.resolution).tolist())
            k = number.get(cell, -1) if beam.hit else -1
            if k >= 0 and self.stands[k]:
                of_scan.setdefault(beam.scan, set()).add(k)
        for elements in of_scan.values():
            for body in self._apart(elements):
                if len(body) >= self.fewest:
                    mean = self.values[body].mean(axis=0)
                    for k in body:
                        self.told[k].append(mean)

    def means(self) -> Float:
        """(E, K) means over the sweeps that saw each element in a body; NaN where none did."""
        unknown = np.full(self.values.shape[1], np.nan)
        return np.array([np.mean(one, axis=0) if one else unknown for one in self.told])

    def _apart(self, elements: set[int]) -> list[list[int]]:
        """Those whose columns touch, corners too, are together."""
        columns: dict[Column, list[int]] = {}
        for k in elements:
            x, y, _ = self.surface.list[k].cell
            columns.setdefault((x // self.column, y // self.column), []).append(k)
        bodies = []
        while columns:
            body, reached = [], [next(iter(columns))]
            while reached:
                x, y = reached.pop()
                body += columns.pop((x, y), [])
                reached += [
                    (x + i, y + j)
                    for i in (-1, 0, 1)
                    for j in (-1, 0, 1)
                    if (x + i, y + j) in columns
                ]
            bodies.append(body)
        return bodies


def feet(
    surface: Surface,
    points: ArrayLike,
    hit: ArrayLike,
    offset: ArrayLike,
    T_map_sensor: ArrayLike,
    element: ArrayLike,
    *,
    stands: ArrayLike,
    p_static: ArrayLike,
    ground: ArrayLike,
    column: int,
    low: float,
    least: float,
    threads: int = 1,  # noqa: ARG001  the core's signature
) -> Float:
    """(M,) mean P(static) of what moves in the column over each beam that ends on the ground.

    Args:
        surface: E elements.
        points, hit, offset, T_map_sensor: M beams.
        element: (M,) in which each ended, -1: none.
        stands: (E,) which elements are of what stands on the ground.
        p_static: (E,).
        ground: (E,) metres, height below each.
        column: cells, edge of the columns over the ground.
        low: metres above the ground up to where an element's mean is the ground's.
        least: metres above the ground from where on a beam did not end on it.
    """
    of, standing = np.asarray(element), np.asarray(stands, bool)
    p, z = np.asarray(p_static, float), np.asarray(ground, float)
    bounds, out = np.asarray(offset), np.full(len(of), np.nan)
    for beam in usable_beams(3, points, hit, offset, T_map_sensor):
        k = of[beam.number]
        if not beam.hit or k < 0 or standing[k] or p[k] < 0.5:
            continue
        if surface.list[k].mean[2] - z[k] > low or _height(surface, k, beam.end, z[k]) <= least:
            continue
        of_scan = of[bounds[beam.scan] : bounds[beam.scan + 1]]
        met = {other for other in of_scan.tolist() if other >= 0 and standing[other]}
        x, y, _ = (cell_of(beam.end, surface.resolution) // column).tolist()
        over = [
            j for j in met if tuple(np.floor_divide(surface.list[j].cell[:2], column)) == (x, y)
        ]
        if over and np.mean(p[over]) < 0.5:
            out[beam.number] = np.mean(p[over])
    return out


def _height(surface: Surface, k: int, end: Float, ground: float) -> float:
    """Metres over the floor that an element is of, or else over the ground."""
    patch = surface.list[k].patch
    if patch is not None and abs(patch.normal[2]) > LEVEL:
        return float(np.sign(patch.normal[2]) * (patch.normal @ (end - patch.centre)))
    return float(end[2] - ground)
