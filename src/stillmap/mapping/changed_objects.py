"""Objects that came and left: which changes are of one, all its cells, and objects in 3D."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stillmap import em
from stillmap.core.array_types import Bool, Cells, Float, Float32, Index
from stillmap.core.recording import Recording
from stillmap.core.square_box import cell_keys, connected_components, neighbor_pairs
from stillmap.em import ChangedCells
from stillmap.mapping.change_detection import Change, group_changes
from stillmap.mapping.doors import is_row

_RADIUS = 3.0  # cells between cells of a recurring change that decide together
_MIN_WEIGHT = 1e-3


def find_shown_cells(
    histories: em.CellHistories, changes: list[Change], state: em.MapState
) -> tuple[Bool, Float32, Float32]:
    """The map in some state, in the cells of places that changed.

    Args:
        histories: of E cells.
        changes: from `detect_changes`, and `join_doors`.
        state: state of changed places that the map shows.

    Returns:
        (E,) cells that changes concern; probability that the map shows something there; that it is
        the leaf of a door, in any position.
    """
    keys = cell_keys(histories.cells)
    listed = np.isin(keys, cell_keys(np.concatenate([change.cells for change in changes])))
    p = histories.p_in_map(state, pool_states(histories, changes, state))
    p_leaf = _weigh_leaves(keys, changes)
    for door in (change.door for change in changes if change.door is not None):
        shown = door.position_in(state)
        for position, leaf in (("open", door.open_cells), ("shut", door.shut_cells)):
            of = _rows(keys, leaf)
            p_leaf[of], p[of], listed[of] = 1.0, float(position == shown), True
    return listed, p, p_leaf


def _weigh_leaves(keys: Cells, changes: list[Change]) -> Float32:
    """(E,) probability that what changed in the cells with these keys is the leaf of a door.

    A straight row of cells that changed may be a leaf that was seen in one position only, or one
    side of a thing. Of all such rows, the share that others are doors by what was seen of them.
    """
    doors = [change for change in changes if change.door is not None]
    rows = [
        change
        for change in changes
        if change.door is None and is_row(change.cells, change.resolution)
    ]
    share = (len(doors) + 1.0) / (len(doors) + len(rows) + 2.0)
    out = np.zeros(len(keys), np.float32)
    for some, p in ((rows, share), (doors, 1.0)):
        for change in some:
            out[_rows(keys, change.cells)] = p
    return out


def pool_states(histories: em.CellHistories, changes: list[Change], state: em.MapState) -> Float32:
    """(E,) `share_there` of each cell, the same in all cells of an object.

    Each cell was observed at times of its own, so that the modal state of an object that was moved
    between two visits differs from cell to cell. An object takes the mean over its cells. Where
    something comes and goes, cells nearby decide together.

    Args:
        histories: of E cells.
        changes: from `detect_changes`.
        state: state of changed places that the map shows.
    """
    keys = cell_keys(histories.cells)
    share = histories.share_there(state)
    weight = np.maximum(histories.p_changing, _MIN_WEIGHT).astype(np.float64)
    out = share.copy()
    recurring = [change.cells for change in changes if change.kind == "comes and goes"]
    if recurring:
        of = _rows(keys, np.concatenate(recurring))
        out[of] = _local_mean(histories.cells[of], share[of], weight[of])
    moved = [change for change in changes if change.kind in ("came", "left")]
    members = [
        _rows(keys, np.concatenate([moved[k].cells for k in indices]))
        for indices in group_objects(moved)
    ]
    for of in members:
        out[of] = 0.0
    for of in filter(len, members):  # where two objects stood in turn, the likelier one
        out[of] = np.maximum(out[of], np.average(share[of], weights=weight[of]))
    return out


def _rows(keys: Cells, cells: Cells) -> Index:
    """Rows, rising, of cells (K, 2) among those with the keys (E,)."""
    return np.flatnonzero(np.isin(keys, cell_keys(cells)))


def _local_mean(cells: Cells, share: Float32, weight: Float) -> Float:
    """(K,) weighted mean of the share (K,) of the cells (K, 2) within a radius of each."""
    pairs = neighbor_pairs(cells, _RADIUS)
    cell, neighbor = np.concatenate([pairs, pairs[:, ::-1]]).T
    sums = [
        value + np.bincount(cell, value[neighbor], minlength=len(cells))
        for value in (weight * share, weight)
    ]
    return np.asarray(sums[0] / sums[1])


def group_objects(changes: list[Change]) -> list[Index]:
    """Indices, rising, of the changes of each object: those of the same place."""
    xy = np.array([(change.x, change.y) for change in changes]).reshape(-1, 2)
    size = np.array([change.size[:2] for change in changes]).reshape(-1, 2)
    near = (np.abs(xy[:, None] - xy) <= size[:, None] + size).all(axis=2)
    pairs = [
        pair
        for pair in np.argwhere(np.triu(near, 1)).tolist()
        if is_same_place(changes[pair[0]], changes[pair[1]])
    ]
    return connected_components(np.array(pairs, np.intp).reshape(-1, 2), len(changes))


def is_same_place(first: Change, second: Change) -> bool:
    """True if the larger of two places holds more than half of the smaller."""
    distance = np.abs([first.x - second.x, first.y - second.y])
    if np.any(distance > np.array(first.size) + np.array(second.size)):
        return False
    smaller, larger = sorted((first.cells, second.cells), key=len)
    return bool(np.mean(np.isin(cell_keys(smaller), cell_keys(larger))) > 0.5)


_MIN_STAY = 12.0  # s: a shorter stay is a wait, a shorter absence an occlusion
_MIN_HEIGHT = 0.4  # m: anything lower is ground observed along other beams
_MIN_AREA = 0.7  # m2 of visible surface
_DWELL_QUANTILE = 0.25  # of the observed times of an object's voxels


def detect_changes_3d(
    changed: ChangedCells, recording: Recording, poses: Float, resolution: float, time_bin: float
) -> list[Change]:
    """Changed places that are objects at rest: high, large and present for long enough.

    `cells` of each are those of the plane (K, 2), `size` has three lengths, and `z` is known.

    Args:
        changed: candidate voxels.
        recording: 3D, deskewed.
        poses: (T, 4, 4) T_map_base.
        resolution: m, edge of a voxel.
        time_bin: s, width of a time bin.
    """
    first, last = recording.stamp_ns[[0, -1]].tolist()
    lasting = _select_lasting(changed, _MIN_STAY / time_bin, 1e-9 * (last - first) / time_bin)
    unchanged = np.zeros((0, 3), np.int64)  # large objects need no test against noise
    objects = [
        change
        for change in group_changes(lasting, unchanged, recording, resolution, time_bin)
        if change.size[2] >= _MIN_HEIGHT
        and len(change.cells) * resolution**2 >= _MIN_AREA
        and 1e-9 * min(change.stamp_ns - first, last - change.before_ns) >= _MIN_STAY
    ]
    dwell_times = measure_dwell_times(objects, recording, poses, resolution)
    return [
        replace(change, cells=np.unique(change.cells[:, :2], axis=0))
        for change, seconds in zip(objects, dwell_times, strict=True)
        if seconds >= _MIN_STAY
    ]


def _select_lasting(changed: ChangedCells, min_bins: float, bins: float) -> ChangedCells:
    """The cells that kept each state for at least `min_bins` of all `bins` time bins."""
    before, after = changed.change_bins[..., 0], changed.change_bins[..., 1]
    once = (after[:, 1] >= min_bins) & (bins - before[:, 1] >= min_bins)
    twice = before[:, 1] - after[:, 0] >= min_bins
    return changed.select(np.where(changed.n_changes == 1, once, twice))


def measure_dwell_times(
    places: Sequence[Change], recording: Recording, poses: Float, resolution: float
) -> list[float]:
    """Seconds for which three quarters of each object's voxels were hit while it stood there.

    A passing vehicle, or an object occluded soon after, arrives as well; but each of its voxels is
    hit for a moment only.

    Args:
        places: changed places; `cells` are (K, 3) voxels.
        recording: 3D, M beams, deskewed.
        poses: (T, 4, 4) T_map_base.
        resolution: metres, edge of a voxel.
    """
    if not places:
        return []
    # the N voxels of all places; one of several places is there several times
    voxels = np.concatenate([change.cells for change in places])
    place = np.repeat(np.arange(len(places)), [len(change.cells) for change in places])
    low, high = voxels.min(axis=0), voxels.max(axis=0)
    shape = tuple((high - low + 1).tolist())
    key = np.ravel_multi_index(tuple((voxels - low).T), shape)
    limits = np.iinfo(np.int64)
    first, last = np.full(len(place), limits.max), np.full(len(place), limits.min)
    since = np.array([change.stamp_ns if change.appeared else limits.min for change in places])
    until = np.array([limits.max if change.appeared else change.before_ns for change in places])
    T_map_sensor = recording.T_map_sensor(poses)
    for t in recording.iter_scans(range(recording.n_scans)):
        stamp, beams, T = int(recording.stamp_ns[t]), recording.beams_of(t), T_map_sensor[t]
        points = recording.points[beams][recording.hit[beams]].astype(np.float64)
        cells = np.floor((points @ T[:3, :3].T + T[:3, 3]) / resolution).astype(np.int64)
        inside = cells[((cells >= low) & (cells <= high)).all(axis=1)] - low
        was_hit = np.isin(key, np.ravel_multi_index(tuple(inside.T), shape))
        was_hit &= ((since <= stamp) & (stamp <= until))[place]
        first[was_hit] = np.minimum(first[was_hit], stamp)
        last[was_hit] = np.maximum(last[was_hit], stamp)
    out = []
    for number, change in enumerate(places):
        its = place == number
        shown = last[its] - change.stamp_ns if change.appeared else change.before_ns - first[its]
        seconds = 1e-9 * np.where(last[its] >= first[its], shown, 0)
        out.append(float(np.quantile(seconds, _DWELL_QUANTILE, method="lower")))
    return out
