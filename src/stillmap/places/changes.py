"""Changes between sessions: cells that are otherwise from a session on, grouped to objects."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.components import connected_components, neighbor_pairs
from stillmap.core.short_repr import ShortRepr
from stillmap.places.place_states import PlaceStates

Float = NDArray[np.float64]
Cells = NDArray[np.int64]
Index = NDArray[np.intp]
Kind = Literal["appeared", "gone", "moved", "door"]

_MIN_PROBABILITY = 0.5  # that a cell changed
_LINK_DISTANCE = 0.3  # m within which changed cells form one object
_MIN_CELLS = {2: 5, 3: 8}  # of a listed change
_NOISE = 2.5  # cells: surfaces of the same class nearer to a static one are noise of poses
# of an object that moved: greatest distance in m, ratio of its sides and of its cells before and
# after, m by which a side may be seen shorter
_MAX_MOTION, _MAX_RATIO, _SIDE_SLACK = 10.0, 1.6, 0.3
_BESIDE = 3.0  # cells between a change and a cell that belongs to it
_CLEAR, _SHARE = 2.0, 0.7  # nats of a clear observation; share of them that a cell beside takes
# m: length of what is seen of a leaf, half its thickness with noise, between the ends at the hinge;
# rad between two positions
_LEAF, _LEAF_THICKNESS, _HINGE_GAP, _MIN_TURN = (0.3, 1.6), 0.12, 0.45, 0.15


@dataclass(frozen=True, eq=False)
class PlaceChange(ShortRepr):
    """Something that is otherwise from one session to the next that looked.

    Attributes:
        kind: it appeared, is gone, moved, or is a door in another position.
        low, high: (D,) m, corners of its box: where it is now, or was.
        from_low, from_high: (D,) of where it was before it moved; None otherwise.
        before, after: indices of the sessions, in the order of time.
        probability: that it changed.
        cells: (K,) indices of its cells in `PlaceStates`, of both positions.
    """

    kind: Kind
    low: Float
    high: Float
    before: int
    after: int
    probability: float
    cells: Index
    from_low: Float | None = None
    from_high: Float | None = None


class _Events(NamedTuple):
    """N changes of single cells: the cell, came or left, last session before and first after."""

    cell: Index
    came: NDArray[np.bool_]
    before: Index
    after: Index

    def select(self, chosen: Index) -> "_Events":
        return _Events._make(column[chosen] for column in self)


def detect_place_changes(place: PlaceStates) -> tuple[PlaceStates, list[PlaceChange]]:
    """The changes between sessions, in the order of time.

    Cells beside a change of which a session says little take the evidence of the change.

    Returns:
        the place with the states of these cells, and the changes.
    """
    groups = _find_groups(place)
    place = _share_evidence(place, groups)
    out = [_make_change(group, place) for group in _find_groups(place)]
    out = _pair_positions(out, place)
    return place, sorted(out, key=lambda one: (one.after, one.before, *one.low.tolist()))


def _find_groups(place: PlaceStates) -> list[_Events]:
    """Events of cells, grouped to objects that came or left between two sessions."""
    events, min_cells = _find_events(place), _MIN_CELLS[place.cells.shape[1]]
    near = _near_static(place, place.cells[events.cell])
    apart, beside = (events.select(np.flatnonzero(mask)) for mask in (~near, near))
    out = []
    for group in _group_events(apart, place):
        out += _split_by_time(group, min_cells)
    return [_attach(group, beside, place) for group in out]


def _attach(group: _Events, beside: _Events, place: PlaceStates) -> _Events:
    """A group with the like events right beside it that are also near static surface."""
    before, after = int(group.before.max()), int(group.after.min())
    like = (beside.came == group.came[0]) & (beside.before < after) & (beside.after > before)
    at = np.flatnonzero(like)
    at = at[_within(place.cells[beside.cell[at]], place.cells[group.cell])]
    return _Events._make(
        np.concatenate([one, other[at]]) for one, other in zip(group, beside, strict=True)
    )


def _within(cells: Cells, others: Cells) -> NDArray[np.bool_]:
    """(n,) whether cells (n, D) lie right beside any of the others."""
    if not len(cells) or not len(others):
        return np.zeros(len(cells), np.bool_)
    from scipy.spatial import cKDTree  # slow to load

    distance, _ = cKDTree(others).query(cells, distance_upper_bound=_BESIDE + 1.0)
    return np.asarray(distance <= _BESIDE)


def _share_evidence(place: PlaceStates, groups: list[_Events]) -> PlaceStates:
    """The place with the evidence of each group in cells beside it that were not seen as clearly.

    Those that stood when the object did, of which a session did not see that they are otherwise.
    """
    evidence = place.evidence.copy()
    for group in groups:
        of = np.unique(group.cell)
        usual = np.median(place.evidence[of], axis=0)
        there = usual > _CLEAR
        gone = usual < -_CLEAR
        if not there.any() or not gone.any():
            continue
        low, high = place.cells[of].min(axis=0) - 3, place.cells[of].max(axis=0) + 3
        inside = np.flatnonzero(((place.cells >= low) & (place.cells <= high)).all(axis=1))
        inside = inside[_within(place.cells[inside], place.cells[of])]
        stood = (place.evidence[inside][:, there] > _CLEAR).any(axis=1)
        seen_since = (place.evidence[inside][:, gone] > _CLEAR).any(axis=1)
        for k in inside[stood & ~seen_since].tolist():
            unclear = np.abs(evidence[k]) < _CLEAR
            evidence[k, unclear] = _SHARE * usual[unclear]
    changed = np.flatnonzero((evidence != place.evidence).any(axis=1))
    return place.with_evidence(evidence, changed)


def _find_events(place: PlaceStates) -> _Events:
    """The changes of all cells that are more probably changing than not."""
    states = place.states
    changed = np.flatnonzero(states.p_changing > _MIN_PROBABILITY)
    path, observed = states.path[changed], states.observed[changed]
    S = path.shape[1]
    columns: list[tuple[Index, NDArray[np.bool_], Index, Index]] = []
    last = np.full(len(changed), -1)  # the last session that observed each cell
    for s in range(S):
        at = np.maximum(last, 0)
        differs = observed[:, s] & (last >= 0) & (path[np.arange(len(path)), at] != path[:, s])
        k = np.flatnonzero(differs)
        columns.append((changed[k], path[k, s], last[k], np.full(len(k), s)))
        last = np.where(observed[:, s], s, last)
    cell, came, before, after = (np.concatenate(column) for column in zip(*columns, strict=True))
    return _Events(cell.astype(np.intp), came.astype(np.bool_), before, after)


def _near_static(place: PlaceStates, cells: Cells) -> NDArray[np.bool_]:
    """(n,) whether cells (n, D) lie so near to static surface that noise explains them."""
    static = place.cells[place.states.p_static > _MIN_PROBABILITY]
    if not len(static) or not len(cells):
        return np.zeros(len(cells), np.bool_)
    from scipy.spatial import cKDTree  # slow to load

    distance, _ = cKDTree(static).query(cells, distance_upper_bound=_NOISE + 1.0)
    return np.asarray(distance <= _NOISE)


def _group_events(events: _Events, place: PlaceStates) -> list[_Events]:
    """Connected events of one kind whose time spans overlap."""
    pairs = neighbor_pairs(place.cells[events.cell], _LINK_DISTANCE / place.resolution)
    i, j = pairs.T
    begin = np.maximum(events.before[i], events.before[j])
    end = np.minimum(events.after[i], events.after[j])
    fits = (events.came[i] == events.came[j]) & (begin < end)
    return [events.select(one) for one in connected_components(pairs[fits], len(events.cell))]


def _split_by_time(events: _Events, min_cells: int) -> list[_Events]:
    """Groups of events that share a span of time: each the span that fits most cells left."""
    out = []
    while len(events.cell) >= min_cells:
        spans = [
            np.flatnonzero((events.before <= s) & (events.after > s))
            for s in range(int(events.before.min()), int(events.after.max()))
        ]
        best = max(spans, key=len)
        if len(best) >= min_cells:
            out.append(events.select(best))
        events = events.select(np.setdiff1d(np.arange(len(events.cell)), best))
    return out


def _make_change(events: _Events, place: PlaceStates) -> PlaceChange:
    cells = np.unique(events.cell)
    low, high = _box(place, cells)
    return PlaceChange(
        "appeared" if events.came[0] else "gone",
        low,
        high,
        int(events.before.max()),
        int(events.after.min()),
        float(place.states.p_changing[cells].mean()),
        cells,
    )


def _box(place: PlaceStates, cells: Index) -> tuple[Float, Float]:
    """Corners (D,) of the box around cells, metres."""
    of = place.cells[cells]
    return of.min(axis=0) * place.resolution, (of.max(axis=0) + 1.0) * place.resolution


def _pair_positions(changes: list[PlaceChange], place: PlaceStates) -> list[PlaceChange]:
    """Objects that are gone in one place and appeared in another at the same time are one."""
    gone = [one for one in changes if one.kind == "gone"]
    came = [one for one in changes if one.kind == "appeared"]
    pairs = []
    for i, one in enumerate(gone):
        for j, other in enumerate(came):
            if (one.before, one.after) == (other.before, other.after):
                kind, cost = _compare_positions(one, other, place)
                if kind:
                    pairs.append((cost, i, j, kind))
    used_gone, used_came, out = set[int](), set[int](), list[PlaceChange]()
    for _, i, j, kind in sorted(pairs):
        if i not in used_gone and j not in used_came:
            used_gone.add(i)
            used_came.add(j)
            out.append(_join(gone[i], came[j], kind, place))
    out += [one for i, one in enumerate(gone) if i not in used_gone]
    return out + [one for j, one in enumerate(came) if j not in used_came]


def _compare_positions(
    gone: PlaceChange, came: PlaceChange, place: PlaceStates
) -> tuple[Kind | None, float]:
    """Classify two positions as a door, a moved object, or unrelated (None), with a cost."""
    # leaves end at most their thickness outside their boxes: others share no hinge
    near = _gap_between(gone, came) <= _HINGE_GAP + 2.0 * _LEAF_THICKNESS
    if near and _is_door(place.cells[gone.cells], place.cells[came.cells], place.resolution):
        return "door", -1.0
    distance = float(np.linalg.norm(0.5 * (gone.low + gone.high - came.low - came.high)))
    sides = np.sort(gone.high - gone.low), np.sort(came.high - came.low)
    shorter, longer = np.minimum(*sides), np.maximum(*sides)
    count = sorted((len(gone.cells), len(came.cells)))
    alike = bool((longer <= _MAX_RATIO * shorter + _SIDE_SLACK).all())
    if alike and count[1] <= 2.0 * _MAX_RATIO * count[0] and distance <= _MAX_MOTION:
        return "moved", distance + float(np.linalg.norm(longer - shorter))
    return None, 0.0


def _gap_between(one: PlaceChange, other: PlaceChange) -> float:
    """m between the boxes of two changes in the plane; 0 where they overlap."""
    gap = np.maximum(one.low - other.high, other.low - one.high)[:2]
    return float(np.linalg.norm(np.maximum(gap, 0.0)))


def _is_door(gone: Cells, came: Cells, resolution: float) -> bool:
    """Whether cells (n, D) that are gone and others that came are a leaf about one hinge.

    Both are straight, about as long as each other and a leaf, and end in one place; cells at the
    hinge are missing, as they lie beside the wall.
    """
    one, other = (
        _fit_leaf(np.asarray(np.unique(cells[:, :2], axis=0) * resolution, np.float64))
        for cells in (gone, came)
    )
    if one is None or other is None:
        return False
    lengths = sorted(float(np.linalg.norm(ends[1] - ends[0])) for ends in (one, other))
    apart = np.linalg.norm(one[:, None] - other[None], axis=2)
    i, j = np.unravel_index(int(apart.argmin()), (2, 2))
    u, v = one[1 - i] - one[i], other[1 - j] - other[j]
    cosine = float(u @ v / (np.linalg.norm(u) * np.linalg.norm(v)))
    turned = np.arccos(np.clip(cosine, -1.0, 1.0))
    alike = lengths[1] <= _MAX_RATIO * lengths[0] + _HINGE_GAP
    return bool(apart[i, j] <= _HINGE_GAP and alike and turned >= _MIN_TURN)


def _fit_leaf(points: Float) -> Float | None:
    """(2, 2) ends of a straight leaf through points (n, 2) in metres; None: they are none."""
    offset = points - points.mean(axis=0)
    axis = np.linalg.eigh(offset.T @ offset)[1][:, 1]
    along, across = offset @ axis, offset @ [-axis[1], axis[0]]
    length = float(np.ptp(along))
    if not _LEAF[0] <= length <= _LEAF[1] or float(np.abs(across).max()) > _LEAF_THICKNESS:
        return None
    ends: Float = points.mean(axis=0) + np.outer([along.min(), along.max()], axis)
    return ends


def _join(gone: PlaceChange, came: PlaceChange, kind: Kind, place: PlaceStates) -> PlaceChange:
    cells = np.union1d(gone.cells, came.cells)
    joined = replace(
        came, kind=kind, cells=cells, probability=min(gone.probability, came.probability)
    )
    if kind == "door":
        low, high = _box(place, cells)
        return replace(joined, low=low, high=high)
    return replace(joined, from_low=gone.low, from_high=gone.high)


def change_records(changes: Sequence[PlaceChange], names: Sequence[str]) -> list[dict[str, object]]:
    """The entries of `changes.json`.

    Args:
        changes: in the order of time.
        names: of the sessions, in the order of time.
    """
    out = []
    for number, one in enumerate(changes):
        record: dict[str, object] = {
            "id": number,
            "kind": one.kind,
            "box": _corners(one.low, one.high),
        }
        if one.from_low is not None and one.from_high is not None:
            record["from_box"] = _corners(one.from_low, one.from_high)
        record["between"] = [names[one.before], names[one.after]]
        record["probability"] = round(one.probability, 4)
        out.append(record)
    return out


def _corners(low: Float, high: Float) -> list[float]:
    """x0, y0, x1, y1, and in 3D z0, z1."""
    plane = [*low[:2], *high[:2]]
    return [round(float(x), 3) for x in (*plane, *(v for z in (low[2:], high[2:]) for v in z))]


def change_cells(
    changes: Sequence[PlaceChange], place: PlaceStates
) -> dict[str, NDArray[np.generic]]:
    """The cells of all changes: `change` (K,) the entry of `changes.json`, and `xy` (K, 2) or `xyz`
    (K, 3), the centres of the cells in metres."""
    cells = [one.cells for one in changes]
    number = np.repeat(np.arange(len(changes), dtype=np.int32), [len(of) for of in cells])
    of = np.concatenate([np.zeros(0, np.intp), *cells])
    D = place.cells.shape[1]
    return {"change": number, "xyz"[:D]: (place.cells[of] + 0.5) * place.resolution}
