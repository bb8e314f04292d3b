"""Projection of a 3D scan to the plane; see `stillmap.mapping.projection`."""

import numpy as np


def project_scan(points, hit, T, ground, heights, cell, directions, open_space):
    """End points (n, 2) in the map frame, whether they are hits, and their beams.

    heights: low, high, top: metres above the ground, of obstacles, and of what shows free space.
    """
    low, high, top = heights
    at = np.flatnonzero(np.isfinite(points).all(axis=1) & (hit | open_space))
    end = points[at].astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    start = T[2, 3] - ground.height_at(T[None, :2, 3])[0]
    above = end[:, 2] - ground.height_at(end[:, :2])
    is_obstacle = hit[at] & (above >= low) & (above <= high)
    beam = (end[:, :2] - T[:2, 3]) * _share_in_band(start, above, low, top)[:, None]
    length = np.hypot(beam[:, 0], beam[:, 1])
    direction = np.floor(np.arctan2(beam[:, 1], beam[:, 0]) * (directions / (2.0 * np.pi)))
    direction = direction.astype(np.int64) % directions
    kept: list[int] = []
    for d in np.unique(direction):
        here = np.flatnonzero(direction == d)
        others, hits = here[~is_obstacle[here]], here[is_obstacle[here]]
        if len(others):
            kept.append(int(others[np.argmax(length[others])]))
        _, first = np.unique(np.floor(length[hits] / cell), return_index=True)
        kept += hits[first].tolist()
    some = np.array(kept, np.intp)
    return T[:2, 3] + beam[some], is_obstacle[some], at[some]


def _share_in_band(start, above, low, top):
    """(n,) share of its length after which a beam leaves the band; heights above the ground."""
    rise = above - start
    with np.errstate(divide="ignore", invalid="ignore"):
        down = np.where(above < low, (start - low) / -rise, 1.0)
        up = np.where(above > top, (top - start) / rise, 1.0)
    return np.clip(np.minimum(down, up), 0.0, 1.0)
