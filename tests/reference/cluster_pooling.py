"""Cluster pooling per sweep, and relabelling of beams that end on the ground below movers."""

# ruff: noqa: ARG001, ARG002  (threads: as the kernels have it)

import numpy as np
from numpy.typing import NDArray

from reference.beam_counting import usable_beams
from reference.ray_traversal import cell_of

Float = NDArray[np.float64]
Column = tuple[int, int]

LEVEL = 0.85  # cosine of the steepest slope of a floor


class ClusterPooling3D:
    """Mean values of the clusters of each sweep, averaged over sweeps per surfel.

    Args:
        surfel_map: E surfels, 3D.
        is_obstacle: (E,) surfels that form clusters.
        values: (E, K) to be averaged.
        column_cells: cells, edge of the vertical columns; adjacent columns are connected.
        min_surfels: smaller clusters are ignored.
    """

    def __init__(self, surfel_map, is_obstacle, values, *, column_cells, min_surfels):
        self.surfel_map, self.column_cells, self.min_surfels = surfel_map, column_cells, min_surfels
        self.is_obstacle = np.asarray(is_obstacle, bool)
        self.values = np.asarray(values, float)
        self.means_of: list[list[Float]] = [[] for _ in range(surfel_map.size)]

    def add(self, points, hit, offset, T_map_sensor, threads=1):
        """Add scans; each of them is clustered by itself."""
        number = self.surfel_map.index_of_cell()
        of_scan: dict[int, set[int]] = {}
        for beam in usable_beams(3, points, hit, offset, T_map_sensor):
            cell = tuple(cell_of(beam.end, self.surfel_map.resolution).tolist())
            k = number.get(cell, -1) if beam.hit else -1
            if k >= 0 and self.is_obstacle[k]:
                of_scan.setdefault(beam.scan, set()).add(k)
        for surfels in of_scan.values():
            for cluster in self._clusters(surfels):
                if len(cluster) >= self.min_surfels:
                    mean = self.values[cluster].mean(axis=0)
                    for k in cluster:
                        self.means_of[k].append(mean)

    def means(self):
        """(E, K) cluster means of each surfel, averaged over sweeps; NaN: in no cluster."""
        unknown = np.full(self.values.shape[1], np.nan)
        return np.array([np.mean(one, axis=0) if one else unknown for one in self.means_of])

    def _clusters(self, surfels):
        """Connected components of columns, 8-neighbourhood."""
        columns: dict[Column, list[int]] = {}
        for k in surfels:
            x, y, _ = self.surfel_map.fitted[k].cell
            columns.setdefault((x // self.column_cells, y // self.column_cells), []).append(k)
        clusters = []
        while columns:
            cluster, reached = [], [next(iter(columns))]
            while reached:
                x, y = reached.pop()
                cluster += columns.pop((x, y), [])
                reached += [
                    (x + i, y + j)
                    for i in (-1, 0, 1)
                    for j in (-1, 0, 1)
                    if (x + i, y + j) in columns
                ]
            clusters.append(cluster)
        return clusters


def relabel_ground_contact(
    surfel_map,
    points,
    hit,
    offset,
    T_map_sensor,
    surfel,
    *,
    is_obstacle,
    p_static,
    ground_height,
    at_any_height,
    column_cells,
    max_ground_height,
    min_end_height,
    threads=1,
):
    """(M,) mean P(static) of the dynamic column above each beam that ends on the ground.

    Args:
        surfel_map: E surfels.
        points, hit, offset, T_map_sensor: M beams.
        surfel: (M,) index of the surfel of each beam, -1: none.
        is_obstacle: (E,) surfels of objects on the ground.
        p_static: (E,).
        ground_height: (E,) metres, of the ground below each surfel.
        at_any_height: (E,) surfels on which beams are relabelled however low they end.
        column_cells: cells, edge of the vertical columns.
        max_ground_height: metres, means of ground surfels are at most so high above the ground.
        min_end_height: metres, beams are relabelled if they end higher above the ground.
    """
    of, obstacle = np.asarray(surfel), np.asarray(is_obstacle, bool)
    p, z = np.asarray(p_static, float), np.asarray(ground_height, float)
    low = np.where(np.asarray(at_any_height, bool), -np.inf, min_end_height)
    bounds, out = np.asarray(offset), np.full(len(of), np.nan)
    for beam in usable_beams(3, points, hit, offset, T_map_sensor):
        k = of[beam.number]
        if not beam.hit or k < 0 or obstacle[k] or p[k] < 0.5:
            continue
        if (
            surfel_map.fitted[k].mean[2] - z[k] > max_ground_height
            or _height(surfel_map, k, beam.end, z[k]) <= low[k]
        ):
            continue
        of_scan = of[bounds[beam.scan] : bounds[beam.scan + 1]]
        hit_surfels = {other for other in of_scan.tolist() if other >= 0 and obstacle[other]}
        x, y, _ = (cell_of(beam.end, surfel_map.resolution) // column_cells).tolist()
        over = [
            j
            for j in hit_surfels
            if tuple(np.floor_divide(surfel_map.fitted[j].cell[:2], column_cells)) == (x, y)
        ]
        if over and np.mean(p[over]) < 0.5:
            out[beam.number] = np.mean(p[over])
    return out


def _height(surfel_map, k, end, ground):
    """Metres above the plane of a level surfel, else above the ground."""
    plane = surfel_map.fitted[k].plane
    if plane is not None and abs(plane.normal[2]) > LEVEL:
        return float(np.sign(plane.normal[2]) * (plane.normal @ (end - plane.centre)))
    return float(end[2] - ground)
