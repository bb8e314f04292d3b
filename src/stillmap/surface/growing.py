"""A surface that grows as the sensor goes on: what it no longer sees becomes triangles.

So memory is that of the voxels around the sensor, and of as many triangles as are asked for.
"""

from collections.abc import Callable
from itertools import product

import numpy as np
from numpy.typing import NDArray

from stillmap import _core
from stillmap.surface import extraction
from stillmap.surface.mesh import Mesh
from stillmap.surface.options import SurfaceOptions
from stillmap.surface.reach import Reach
from stillmap.surface.thinning import thinned, within_budget

Tell = Callable[[int, int], None]
Tile = tuple[int, int, int]

_MORE = 48e6  # bytes of voxels after which it is asked what is no longer seen
_BATCH = 250_000  # triangles that wait to be thinned out together
_SPARE = 2  # times as many triangles as are asked for, meanwhile
_BELOW = [way for way in product((-1, 0), repeat=3) if any(way)]


class Growing:
    """What is known of a surface: distances in voxels, and triangles where nothing more comes."""

    def __init__(self, distances: _core.SignedDistances, options: SurfaceOptions) -> None:
        self.distances = distances
        self.options = options
        self.error = options.error_for(distances.voxel)
        self._mesh = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
        self._waiting = list[Mesh]()
        self._taken = set[Tile]()
        self._held = 0.0

    def is_large(self) -> bool:
        """Whether so many voxels came since the last look that another one pays."""
        return self.distances.memory_bytes > self._held + _MORE

    def let_go(self, reach: Reach, done: int) -> None:
        """Makes triangles of what patches from number `done` on do not come to."""
        tiles = extraction.tiles_of(self.distances)
        edge = extraction.TILE * self.distances.voxel
        self._take(tiles[reach.settled(tiles, edge, done)])
        self._forget()
        self._held = self.distances.memory_bytes

    def finished(self, tell: Tell | None = None) -> Mesh:
        """All of it, within the budget; `tell`: what is done of the tiles that were left."""
        self._take(extraction.tiles_of(self.distances), tell)
        self._merge()
        whole = extraction.without_islands(self._mesh, self.options.island)
        return within_budget(thinned(whole, self.error), self.error, self.options.faces)

    def _take(self, tiles: NDArray[np.int64], tell: Tell | None = None) -> None:
        for done, tile in enumerate(tiles, start=1):
            key = _key(tile)
            if key not in self._taken:
                self._taken.add(key)
                part = extraction.extracted(self.distances, tile, self.options.fewest)
                if len(part):
                    self._waiting.append(thinned(part, self.error))
            if sum(map(len, self._waiting)) > max(_BATCH, len(self._mesh)):
                self._merge()
            if tell:
                tell(done, len(tiles))

    def _forget(self) -> None:
        """Voxels of tiles that are triangles, but those on which tiles below still border."""
        blocks = self.distances.blocks()
        of_block = [_key(tile) for tile in blocks // extraction.blocks_along(self.distances)]
        there = set(of_block)
        gone = {
            (x, y, z)
            for x, y, z in there & self._taken
            if not any((x + i, y + j, z + k) in there - self._taken for i, j, k in _BELOW)
        }
        self.distances.forget(blocks[[key in gone for key in of_block]])

    def _merge(self) -> None:
        """One mesh; its border stays as it is, as more may come to it."""
        whole = extraction.joined_whole([self._mesh, *self._waiting])
        self._waiting = []
        if len(whole) > _BATCH:
            whole = thinned(whole, self.error)
            most = _SPARE * self.options.faces
            whole = within_budget(whole, self.error, most, whole_border=True)
        self._mesh = whole


def _key(tile: NDArray[np.int64]) -> Tile:
    x, y, z = tile.tolist()
    return x, y, z
