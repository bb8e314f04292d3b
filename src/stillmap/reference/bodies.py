"""What stands apart in a sweep is one body: what is known of its parts, on average."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stillmap.reference.beams import usable_beams
from stillmap.reference.surface import Surface
from stillmap.reference.traverse import cell_of

Float = NDArray[np.float64]
Column = tuple[int, int]


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
