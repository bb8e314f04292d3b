"""The surface of what stands still, from beams by how likely they hit something static."""

from collections.abc import Callable, Iterable
from functools import partial
from itertools import chain, product

import numpy as np
from numpy.typing import NDArray

from stillmap import _core
from stillmap.recording.model import Recording
from stillmap.surface.growing import Growing
from stillmap.surface.mesh import Mesh
from stillmap.surface.options import SurfaceOptions
from stillmap.surface.patches import Patch, order_of, patches_of
from stillmap.surface.reach import Reach, reach_of
from stillmap.surface.resolution import resolution_of
from stillmap.threads import in_order

Float = NDArray[np.float64]
Tell = Callable[[int, int], None]

_ASKED = 64  # scans of which the ranges are looked at
_LEAST = 1e-3  # m, edge of the cells by which scans nearby are found
_AROUND = list(product((-1, 0, 1), repeat=3))


def surface_of(
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
    chosen = chosen_scans(T, seen.sensor, usual_range(seen), options)
    order = order_of(seen, chosen, options)
    reach = reach_of(seen, poses, order)
    voxel, stride = resolution_of(seen, poses, order, reach, options)
    order = order._replace(stride=stride)
    n, done = len(order.groups), 0

    def weighed(make: Callable[[], Patch]) -> tuple[Patch, NDArray[np.float32]]:
        patch = make()
        return patch, static_weights(patch, p_static, options.least)

    def each() -> Iterable[tuple[Patch, NDArray[np.float32]]]:
        nonlocal done
        for one in in_order(weighed, patches_of(seen, poses, order, options), threads):
            yield one
            done += 1
            if tell:
                tell(done, 2 * n)

    later = partial(_second_half, tell, n) if tell else None
    return fused(each(), voxel, options, threads, later, reach)


def _second_half(tell: Tell, n: int, done: int, total: int) -> None:
    tell(n + n * done // total, 2 * n)


def fused(
    patches: Iterable[tuple[Patch, NDArray[np.float32]]],
    voxel: float,
    options: SurfaceOptions,
    threads: int = 1,
    tell: Tell | None = None,
    reach: Reach | None = None,
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
    growing = Growing(_core.SignedDistances(voxel, before=before, behind=behind), options)
    for done, (patch, weight) in enumerate(patches, start=1):
        growing.distances.add(
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


def usual_range(seen: Recording) -> float:
    """Median range in metres of the hits of some scans; 0 where there are none."""
    asked = np.unique(np.linspace(0, seen.n_scans - 1, min(seen.n_scans, _ASKED)).astype(np.intp))
    parts = [seen.points[b][seen.hit[b]] for b in map(seen.beams_of, asked)]
    ranges = np.concatenate([np.zeros(0), *(np.linalg.norm(part, axis=1) for part in parts)])
    ranges = ranges[np.isfinite(ranges)]
    return float(np.median(ranges)) if len(ranges) else 0.0


def chosen_scans(
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
