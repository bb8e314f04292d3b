"""What stands apart in a sweep is one body: what is known of its parts, on average."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reference.beam_counting import usable_beams
from reference.ray_traversal import cell_of
from reference.surfel_map import SurfelMap

Float = NDArray[np.float64]
Column = tuple[int, int]

LEVEL = 0.85  # cosine of the slope from which on a surface is no floor


class ClusterPooling3D:
    """What sweeps say of the body around each element.

    Args:
        surfel_map: E elements, in space.
        is_obstacle: (E,) of which of them bodies consist.
        values: (E, K) what is known of each.
        column_cells: cells, edge of the columns over the ground that touch within a body.
        min_surfels: elements of a body at least.
    """

    def __init__(
        self,
        surfel_map: SurfelMap,
        is_obstacle: ArrayLike,
        values: ArrayLike,
        *,
        column_cells: int,
        min_surfels: int,
    ) -> None:
        self.surfel_map, self.column_cells, self.min_surfels = surfel_map, column_cells, min_surfels
        self.is_obstacle = np.asarray(is_obstacle, bool)
        self.values = np.asarray(values, float)
        self.told: list[list[Float]] = [[] for _ in range(surfel_map.size)]

    def add(
        self,
        points: ArrayLike,
        hit: ArrayLike,
        offset: ArrayLike,
        T_map_sensor: ArrayLike,
        threads: int = 1,  # noqa: ARG002  the core's signature
    ) -> None:
        """Each scan is a sweep."""
        number = self.surfel_map.numbers()
        of_scan: dict[int, set[int]] = {}
        for beam in usable_beams(3, points, hit, offset, T_map_sensor):
            cell = tuple(cell_of(beam.end, self.surfel_map.resolution).tolist())
            k = number.get(cell, -1) if beam.hit else -1
            if k >= 0 and self.is_obstacle[k]:
                of_scan.setdefault(beam.scan, set()).add(k)
        for elements in of_scan.values():
            for body in self._apart(elements):
                if len(body) >= self.min_surfels:
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
            x, y, _ = self.surfel_map.list[k].cell
            columns.setdefault((x // self.column_cells, y // self.column_cells), []).append(k)
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


def relabel_ground_contact(
    surfel_map: SurfelMap,
    points: ArrayLike,
    hit: ArrayLike,
    offset: ArrayLike,
    T_map_sensor: ArrayLike,
    surfel: ArrayLike,
    *,
    is_obstacle: ArrayLike,
    p_static: ArrayLike,
    ground_height: ArrayLike,
    column_cells: int,
    max_ground_height: float,
    min_end_height: float,
    threads: int = 1,  # noqa: ARG001  the core's signature
) -> Float:
    """(M,) mean P(static) of what moves in the column over each beam that ends on the ground.

    Args:
        surfel_map: E elements.
        points, hit, offset, T_map_sensor: M beams.
        surfel: (M,) in which each ended, -1: none.
        is_obstacle: (E,) which elements are of what stands on the ground.
        p_static: (E,).
        ground_height: (E,) metres, height below each.
        column_cells: cells, edge of the columns over the ground.
        max_ground_height: metres above the ground up to where an element's mean is the ground's.
        min_end_height: metres above the ground from where on a beam did not end on it.
    """
    of, standing = np.asarray(surfel), np.asarray(is_obstacle, bool)
    p, z = np.asarray(p_static, float), np.asarray(ground_height, float)
    bounds, out = np.asarray(offset), np.full(len(of), np.nan)
    for beam in usable_beams(3, points, hit, offset, T_map_sensor):
        k = of[beam.number]
        if not beam.hit or k < 0 or standing[k] or p[k] < 0.5:
            continue
        if (
            surfel_map.list[k].mean[2] - z[k] > max_ground_height
            or _height(surfel_map, k, beam.end, z[k]) <= min_end_height
        ):
            continue
        of_scan = of[bounds[beam.scan] : bounds[beam.scan + 1]]
        met = {other for other in of_scan.tolist() if other >= 0 and standing[other]}
        x, y, _ = (cell_of(beam.end, surfel_map.resolution) // column_cells).tolist()
        over = [
            j
            for j in met
            if tuple(np.floor_divide(surfel_map.list[j].cell[:2], column_cells)) == (x, y)
        ]
        if over and np.mean(p[over]) < 0.5:
            out[beam.number] = np.mean(p[over])
    return out


def _height(surfel_map: SurfelMap, k: int, end: Float, ground: float) -> float:
    """Metres over the floor that an element is of, or else over the ground."""
    patch = surfel_map.list[k].patch
    if patch is not None and abs(patch.normal[2]) > LEVEL:
        return float(np.sign(patch.normal[2]) * (patch.normal @ (end - patch.centre)))
    return float(end[2] - ground)
