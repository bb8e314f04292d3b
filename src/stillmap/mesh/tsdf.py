"""The surface of what stands still, from beams by how likely they hit something static.

A surface that grows as the sensor goes on: what it no longer sees becomes triangles.

So memory is that of the voxels around the sensor, and of as many triangles as are asked for.
"""

from collections.abc import Callable, Iterable
from functools import partial
from itertools import chain, product

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.parallel import map_ordered
from stillmap.core.recording import Recording
from stillmap.mesh import marching_cubes
from stillmap.mesh.options import SurfaceOptions
from stillmap.mesh.range_image import Patch, find_scan_layout, triangulate_scans
from stillmap.mesh.resolution import PatchExtents, choose_resolution, patch_extents
from stillmap.mesh.simplification import simplify, simplify_to_budget
from stillmap.mesh.triangle_mesh import Mesh

Float = NDArray[np.float64]

Tell = Callable[[int, int], None]

Tile = tuple[int, int, int]

_MORE = 48e6  # bytes of voxels after which it is asked what is no longer seen

_BATCH = 250_000  # triangles that wait to be thinned out together

_SPARE = 2  # times as many triangles as are asked for, meanwhile

_BELOW = [way for way in product((-1, 0), repeat=3) if any(way)]


class StreamingSurface:
    """What is known of a surface: distances in voxels, and triangles where nothing more comes."""

    def __init__(self, distances: _core.TsdfVolume, options: SurfaceOptions) -> None:
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

    def let_go(self, reach: PatchExtents, done: int) -> None:
        """Makes triangles of what patches from number `done` on do not come to."""
        tiles = marching_cubes.occupied_tiles(self.distances)
        edge = marching_cubes.TILE * self.distances.voxel
        self._take(tiles[reach.is_complete(tiles, edge, done)])
        self._forget()
        self._held = self.distances.memory_bytes

    def finished(self, tell: Tell | None = None) -> Mesh:
        """All of it, within the budget; `tell`: what is done of the tiles that were left."""
        self._take(marching_cubes.occupied_tiles(self.distances), tell)
        self._merge()
        whole = marching_cubes.remove_small_components(self._mesh, self.options.island)
        return simplify_to_budget(simplify(whole, self.error), self.error, self.options.faces)

    def _take(self, tiles: NDArray[np.int64], tell: Tell | None = None) -> None:
        for done, tile in enumerate(tiles, start=1):
            key = _key(tile)
            if key not in self._taken:
                self._taken.add(key)
                part = marching_cubes.extract_tile(self.distances, tile, self.options.fewest)
                if len(part):
                    self._waiting.append(simplify(part, self.error))
            if sum(map(len, self._waiting)) > max(_BATCH, len(self._mesh)):
                self._merge()
            if tell:
                tell(done, len(tiles))

    def _forget(self) -> None:
        """Voxels of tiles that are triangles, but those on which tiles below still border."""
        blocks = self.distances.blocks()
        of_block = [_key(tile) for tile in blocks // marching_cubes.blocks_per_tile(self.distances)]
        there = set(of_block)
        gone = {
            (x, y, z)
            for x, y, z in there & self._taken
            if not any((x + i, y + j, z + k) in there - self._taken for i, j, k in _BELOW)
        }
        self.distances.remove_blocks(blocks[[key in gone for key in of_block]])

    def _merge(self) -> None:
        """One mesh; its border stays as it is, as more may come to it."""
        whole = marching_cubes.weld_meshes([self._mesh, *self._waiting])
        self._waiting = []
        if len(whole) > _BATCH:
            whole = simplify(whole, self.error)
            most = _SPARE * self.options.faces
            whole = simplify_to_budget(whole, self.error, most, whole_border=True)
        self._mesh = whole


def _key(tile: NDArray[np.int64]) -> Tile:
    x, y, z = tile.tolist()
    return x, y, z


_ASKED = 64  # scans of which the ranges are looked at

_LEAST = 1e-3  # m, edge of the cells by which scans nearby are found

_AROUND = list(product((-1, 0, 1), repeat=3))


def build_surface(
    seen: Recording,
    poses: Float,
    p_static: NDArray[np.float32],
    options: SurfaceOptions,
    threads: int = 1,
    tell: Tell | None = None,
) -> Mesh:
    """The surface of what stands still, in the map frame.

    Args:
        seen: 3D, M beams, without motion during its scans.
        poses: (T, 4, 4) T_map_base.
        p_static: (M,) P(static) of each beam, NaN where it is not known.
        options: see SurfaceOptions.
        threads: same result with any number.
        tell: called with what is done and what there is to do.
    """
    T = seen.T_map_sensor(poses)
    chosen = select_scans(T, seen.sensor, median_range(seen), options)
    order = find_scan_layout(seen, chosen, options)
    reach = patch_extents(seen, poses, order)
    voxel, stride = choose_resolution(seen, poses, order, reach, options)
    order = order._replace(stride=stride)
    n, done = len(order.groups), 0

    def weighed(make: Callable[[], Patch]) -> tuple[Patch, NDArray[np.float32]]:
        patch = make()
        return patch, static_weights(patch, p_static, options.least)

    def each() -> Iterable[tuple[Patch, NDArray[np.float32]]]:
        nonlocal done
        for one in map_ordered(weighed, triangulate_scans(seen, poses, order, options), threads):
            yield one
            done += 1
            if tell:
                tell(done, 2 * n)

    later = partial(_second_half, tell, n) if tell else None
    return integrate_patches(each(), voxel, options, threads, later, reach)


def _second_half(tell: Tell, n: int, done: int, total: int) -> None:
    tell(n + n * done // total, 2 * n)


def integrate_patches(
    patches: Iterable[tuple[Patch, NDArray[np.float32]]],
    voxel: float,
    options: SurfaceOptions,
    threads: int = 1,
    tell: Tell | None = None,
    reach: PatchExtents | None = None,
) -> Mesh:
    """One surface of many patches, in the frame of their points.

    Args:
        patches: each with the weight (m,) of its faces; those that weigh nothing are left out.
        voxel: edge in metres.
        options: see SurfaceOptions.
        threads: same result with any number.
        tell: called with what is done and what there is to do, once the patches are through.
        reach: how far patches go; without it all voxels are kept to the end.
    """
    before, behind = options.before * voxel, options.behind * voxel
    growing = StreamingSurface(
        _core.TsdfVolume(voxel, truncation_front=before, truncation_back=behind), options
    )
    for done, (patch, weight) in enumerate(patches, start=1):
        growing.distances.integrate(
            patch.points, patch.origin, patch.standoff, patch.faces, weight, threads=threads
        )
        if reach is not None and growing.is_large():
            growing.let_go(reach, done)
    return growing.finished(tell)


def static_weights(
    patch: Patch, p_static: NDArray[np.float32], least: float
) -> NDArray[np.float32]:
    """(m,) weights of a patch's faces: P(static) of all three beams, 0 below `least`."""
    p = np.nan_to_num(p_static[patch.beam].astype(np.float64), nan=0.0)
    a, b, c = patch.faces.T
    weight = p[a] * p[b] * p[c]
    return np.where(weight >= least, weight, 0.0).astype(np.float32)


def median_range(seen: Recording) -> float:
    """Median range in metres of the hits of some scans; 0 where there are none."""
    asked = np.unique(np.linspace(0, seen.n_scans - 1, min(seen.n_scans, _ASKED)).astype(np.intp))
    parts = [seen.points[b][seen.hit[b]] for b in map(seen.beams_of, asked)]
    ranges = np.concatenate([np.zeros(0), *(np.linalg.norm(part, axis=1) for part in parts)])
    ranges = ranges[np.isfinite(ranges)]
    return float(np.median(ranges)) if len(ranges) else 0.0


def select_scans(
    T_map_sensor: Float, sensor: NDArray[np.int32], range: float, o: SurfaceOptions
) -> NDArray[np.intp]:
    """The scans that tell something new: so many from each place, and for each direction.

    Args:
        T_map_sensor: (T, 4, 4).
        sensor: (T,) which sensor took each.
        range: metres, usual.
        o: `apart`, `turned` and `looks`.
    """
    place, R = T_map_sensor[:, :3, 3], T_map_sensor[:, :3, :3]
    apart = o.apart * range
    # by cells, so that each scan is compared with those about alone
    cells = np.floor(place / max(apart, _LEAST)).astype(np.int64).tolist()
    known: dict[tuple[int, ...], list[int]] = {}
    chosen = list[int]()
    for t, (x, y, z) in enumerate(cells):
        mine = int(sensor[t])
        about = [known.get((mine, x + i, y + j, z + k), ()) for i, j, k in _AROUND]
        before = np.fromiter(chain.from_iterable(about), np.intp)
        near = before[np.linalg.norm(place[before] - place[t], axis=1) < apart]
        cosine = 0.5 * (np.einsum("nij,ij->n", R[near], R[t]) - 1.0)
        if np.count_nonzero(cosine > np.cos(o.turned)) < o.looks:
            chosen.append(t)
            known.setdefault((mine, x, y, z), []).append(t)
    return np.array(chosen, np.intp)
