"""Changes between sessions: cells that are otherwise from a session on, grouped to objects; among
them door leaves, which are straight, hinged, and beside a gap in a wall that they could shut."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Bool, Float, Index
from stillmap.core.short_repr import ShortRepr
from stillmap.mapping.change_detection import Events, group_events
from stillmap.places.place_states import PlaceStates, are_near
from stillmap.results.timeline import Kind

# m: length of what is seen of a leaf, half its thickness with noise
_LENGTH, _THICKNESS = (0.3, 1.6), 0.12
# m: between what is seen of a leaf and its hinge or the latch, as cells beside walls are missing
_END_GAP = 0.35
_WIDTH = (0.6, 1.4)  # m, of the gap in the wall
_POST = 0.2  # m of wall on either side of the gap, within _THICKNESS of its line
_DIRECTIONS = 72  # of the line of a gap that are tried
_STEP = 0.05  # m along a line
_MAX_TURN_GAP = 0.45  # m between the ends at the hinge of two positions of a leaf
_MAX_LEAF_RATIO = 1.6  # of the lengths that are seen of two positions
_MIN_TURN = 0.15  # rad between two positions


class Leaf(NamedTuple):
    """Ends (2, 2) and length of a leaf as it was observed, metres."""

    ends: Float
    length: float


def fit_leaf(points: Float) -> Leaf | None:
    """The straight leaf through points (n, 2) in metres; None: they are none."""
    offset = points - points.mean(axis=0)
    axis = np.linalg.eigh(offset.T @ offset)[1][:, 1]
    along, across = se2.along_and_across(offset, axis)
    length = float(np.ptp(along))
    if not _LENGTH[0] <= length <= _LENGTH[1] or float(np.abs(across).max()) > _THICKNESS:
        return None
    ends: Float = points.mean(axis=0) + np.outer([along.min(), along.max()], axis)
    return Leaf(ends, length)


def turn_about_hinge(first: Leaf, second: Leaf) -> bool:
    """True if two leaves are one in two positions: as long as each other, with a common end."""
    apart = np.linalg.norm(first.ends[:, None] - second.ends[None], axis=2)
    i, j = np.unravel_index(int(apart.argmin()), (2, 2))
    u, v = first.ends[1 - i] - first.ends[i], second.ends[1 - j] - second.ends[j]
    cosine = float(u @ v / (np.linalg.norm(u) * np.linalg.norm(v)))
    turned = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
    lengths = sorted((first.length, second.length))
    alike = lengths[1] <= _MAX_LEAF_RATIO * lengths[0] + _MAX_TURN_GAP
    return bool(apart[i, j] <= _MAX_TURN_GAP and alike and turned >= _MIN_TURN)


def is_hinged(leaf: Leaf, wall: Float) -> bool:
    """True if a leaf ends where a wall does, beside a gap that it could shut.

    Args:
        leaf: what is seen of it.
        wall: (n, 2) points of static surface around it, metres, without the leaf's own.
    """
    if leaf.length > _WIDTH[1] or not len(wall):
        return False
    angles = np.arange(_DIRECTIONS) * (2.0 * np.pi / _DIRECTIONS)
    for end, far_end in (leaf.ends, leaf.ends[::-1]):
        own = float(np.arctan2(*(far_end - end)[::-1]))
        reach = np.linalg.norm(wall - end, axis=1)
        if reach.min() > _END_GAP:
            continue
        near = wall[reach <= _WIDTH[1] + 2.0 * _END_GAP]
        if any(_is_gap(end, angle, leaf.length, near) for angle in (own, *angles.tolist())):
            return True
    return False


def _is_gap(end: Float, angle: float, length: float, wall: Float) -> bool:
    """True if a wall ends near a point and goes on in a direction, a leaf's width away."""
    u = np.array([np.cos(angle), np.sin(angle)])
    along, across = se2.along_and_across(wall - end, u)
    along = along[np.abs(across) <= _THICKNESS]
    behind, ahead = along[along < length / 2.0], along[along >= length / 2.0]
    if not len(behind) or not len(ahead):
        return False
    first, last = float(behind.max()), float(ahead.min())
    width = last - first
    if not (_WIDTH[0] <= width <= _WIDTH[1] and abs(first) <= _END_GAP and width >= length - 0.1):
        return False
    posts = (first - along[along <= first]), (along[along >= last] - last)
    return all(_covers(post) for post in posts) and width <= length + 2.0 * _END_GAP


def _covers(depth: Float) -> bool:
    """True if points at depths (n,) in a wall, metres, fill its first part."""
    filled = np.unique(np.floor(depth[depth < _POST] / _STEP))
    return len(filled) >= 0.75 * _POST / _STEP


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


_MIN_PROBABILITY = 0.5  # that a cell changed
_LINK_DISTANCE = 0.3  # m within which changed cells form one object
# of an object away from static surface, and with what lies beside it: fewer are feet of who stood
_MIN_CELLS, _MIN_LISTED = {2: 5, 3: 8}, {2: 8, 3: 8}
_NOISE = 2.5  # cells: surfaces of the same class nearer to a static one are noise of poses
# of an object that moved: greatest distance in m, ratio of its sides and of its cells before and
# after, m by which a side may be seen shorter
_MAX_MOTION, _MAX_RATIO, _SIDE_SLACK = 10.0, 1.6, 0.3
_BESIDE = 3.0  # cells between a change and a cell that belongs to it
_CLEAR, _SHARE = 2.0, 0.7  # nats of a clear observation; share of them that a cell beside takes
_WALL_MARGIN = 2.0  # m around a leaf in which its gap is looked for


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
    out.sort(key=lambda change: (change.after, change.before, *change.low.tolist()))
    return place, out


def _find_groups(place: PlaceStates) -> list[Events]:
    """Events of cells, grouped to objects that came or left between two sessions."""
    events, min_cells = _find_events(place), _MIN_CELLS[place.cells.shape[1]]
    static = place.cells[place.states.p_static > _MIN_PROBABILITY]
    near = are_near(place.cells[events.cell], static, _NOISE)
    apart, beside = (events.select(np.flatnonzero(mask)) for mask in (~near, near))
    out = []
    radius = _LINK_DISTANCE / place.resolution
    for group in group_events(apart, place.cells, radius):
        out += _split_by_time(group, min_cells)
    out = [_attach(group, beside, place) for group in out]
    min_listed = _MIN_LISTED[place.cells.shape[1]]
    return [group for group in out if len(np.unique(group.cell)) >= min_listed]


def _attach(group: Events, beside: Events, place: PlaceStates) -> Events:
    """A group with the like events right beside it that are also near static surface.

    Of those that fit its span of time, the ones that share a part of it with most others.
    """
    before, after = int(group.before.max()), int(group.after.min())
    like = (beside.came == group.came[0]) & (beside.before < after) & (beside.after > before)
    at = np.flatnonzero(like)
    at = at[are_near(place.cells[beside.cell[at]], place.cells[group.cell], _BESIDE)]
    first, last = beside.before[at], beside.after[at]
    at = max((at[(first <= s) & (last > s)] for s in range(before, after)), key=len)
    columns = zip(group, beside, strict=True)
    return Events._make(np.concatenate([own, further[at]]) for own, further in columns)


def _share_evidence(place: PlaceStates, groups: list[Events]) -> PlaceStates:
    """The place with the evidence of each group in cells beside it that were not seen as clearly.

    Those that stood when the object did, of which a session did not see that they are otherwise.
    Where objects change, sessions lie so well on each other that a cell counts by itself: near a
    jamb the tolerance would fill the gap of an open door.
    """
    evidence = place.evidence.copy()
    is_static = place.states.p_static > _MIN_PROBABILITY
    for group in groups:
        of = np.unique(group.cell)
        usual = np.median(place.evidence[of], axis=0)
        there, gone = usual > _CLEAR, usual < -_CLEAR
        if not there.any() or not gone.any():
            continue
        low, high = place.cells[of].min(axis=0) - 3, place.cells[of].max(axis=0) + 3
        inside = np.flatnonzero(((place.cells >= low) & (place.cells <= high)).all(axis=1))
        inside = inside[are_near(place.cells[inside], place.cells[of], _BESIDE)]
        of_each = np.where(is_static[inside, None], place.own[inside], place.evidence[inside])
        stood, stands_since = ((of_each[:, s] > _CLEAR).any(axis=1) for s in (there, gone))
        fits = stood & ~stands_since
        of_each = of_each[fits]
        evidence[inside[fits]] = np.where(np.abs(of_each) < _CLEAR, _SHARE * usual, of_each)
    changed = np.flatnonzero((evidence != place.evidence).any(axis=1))
    return place.with_evidence(evidence, changed)


def _find_events(place: PlaceStates) -> Events:
    """The changes of all cells that are more probably changing than not."""
    states = place.states
    changed = np.flatnonzero(states.p_changing > _MIN_PROBABILITY)
    path, observed = states.path[changed], states.observed[changed]
    S = path.shape[1]
    columns: list[tuple[Index, Bool, Index, Index]] = []
    last = np.full(len(changed), -1)  # the last session that observed each cell
    for s in range(S):
        at = np.maximum(last, 0)
        differs = observed[:, s] & (last >= 0) & (path[np.arange(len(path)), at] != path[:, s])
        k = np.flatnonzero(differs)
        columns.append((changed[k], path[k, s], last[k], np.full(len(k), s)))
        last = np.where(observed[:, s], s, last)
    cell, came, before, after = (np.concatenate(column) for column in zip(*columns, strict=True))
    return Events(cell.astype(np.intp), came.astype(np.bool_), before, after)


def _split_by_time(events: Events, min_cells: int) -> list[Events]:
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


def _make_change(events: Events, place: PlaceStates) -> PlaceChange:
    cells = np.unique(events.cell)
    kind: Kind = "appeared" if events.came[0] else "gone"
    between = int(events.before.max()), int(events.after.min())
    probability = float(place.states.p_changing[cells].mean())
    return PlaceChange(kind, *_box(place, cells), *between, probability, cells)


def _box(place: PlaceStates, cells: Index) -> tuple[Float, Float]:
    """Corners (D,) of the box around cells, metres."""
    of = place.cells[cells]
    return of.min(axis=0) * place.resolution, (of.max(axis=0) + 1.0) * place.resolution


def _pair_positions(changes: list[PlaceChange], place: PlaceStates) -> list[PlaceChange]:
    """Objects that are gone in one place and appeared in another at the same time are one."""
    hinged = _find_doors(changes, place)
    gone = [k for k, change in enumerate(changes) if change.kind == "gone"]
    came = [k for k, change in enumerate(changes) if change.kind == "appeared"]
    pairs = []
    for i in gone:
        for j in came:
            old, new = changes[i], changes[j]
            if (old.before, old.after) == (new.before, new.after):
                kind, cost = _compare_positions(old, new, place, bool(hinged & {i, j}))
                if kind:
                    pairs.append((cost, i, j, kind))
    used, out = set[int](), list[PlaceChange]()
    for _, i, j, kind in sorted(pairs):
        if not used & {i, j}:
            used |= {i, j}
            out.append(_join(changes[i], changes[j], kind, place))
    # most often one position of a door is seen: shut it hides the other, open it stands aside
    out += [replace(changes[k], kind="door") for k in sorted(hinged - used)]
    return out + [change for k, change in enumerate(changes) if k not in used | hinged]


def _compare_positions(
    gone: PlaceChange, came: PlaceChange, place: PlaceStates, has_hinge: bool
) -> tuple[Kind | None, float]:
    """Classify two positions as a door, a moved object, or unrelated (None), with a cost.

    has_hinge: whether one of them stands beside a gap in a wall that it could shut.
    """
    if has_hinge:
        before, after = _fit_leaf(place, gone.cells), _fit_leaf(place, came.cells)
        turned = before is not None and after is not None and turn_about_hinge(before, after)
        return ("door", -1.0) if turned else (None, 0.0)
    distance = float(np.linalg.norm(0.5 * (gone.low + gone.high - came.low - came.high)))
    sides = np.sort(gone.high - gone.low), np.sort(came.high - came.low)
    shorter, longer = np.minimum(*sides), np.maximum(*sides)
    count = sorted((len(gone.cells), len(came.cells)))
    alike = bool((longer <= _MAX_RATIO * shorter + _SIDE_SLACK).all())
    if alike and count[1] <= 2.0 * _MAX_RATIO * count[0] and distance <= _MAX_MOTION:
        return "moved", distance + float(np.linalg.norm(longer - shorter))
    return None, 0.0


def _fit_leaf(place: PlaceStates, cells: Index) -> Leaf | None:
    """The leaf that changed cells are, seen from above."""
    plane = np.unique(place.cells[cells][:, :2], axis=0)
    return fit_leaf(np.asarray((plane + 0.5) * place.resolution, np.float64))


def _find_doors(changes: list[PlaceChange], place: PlaceStates) -> set[int]:
    """The changes that are a leaf beside a gap in a wall that it could shut."""
    is_static = place.states.p_static > _MIN_PROBABILITY
    for change in changes:
        is_static[change.cells] = False
    static = place.cells[is_static]
    margin = np.full(static.shape[1], np.ceil(_WALL_MARGIN / place.resolution))
    out = set()
    for k, change in enumerate(changes):
        leaf = _fit_leaf(place, change.cells)
        if leaf is None:
            continue
        low, high = change.low / place.resolution - margin, change.high / place.resolution + margin
        if len(low) == 3:  # walls at the height of its upper half, without floor and lintel
            low[2] = (0.5 * (change.low + change.high) / place.resolution)[2]
            high[2] -= margin[2]
        near = static[((static >= low) & (static < high)).all(axis=1)]
        wall = (np.unique(near[:, :2], axis=0) + 0.5) * place.resolution
        if is_hinged(leaf, np.asarray(wall)):
            out.add(k)
    return out


def _join(gone: PlaceChange, came: PlaceChange, kind: Kind, place: PlaceStates) -> PlaceChange:
    cells = np.union1d(gone.cells, came.cells)
    joined = replace(
        came, kind=kind, cells=cells, probability=min(gone.probability, came.probability)
    )
    if kind == "door":
        low, high = _box(place, cells)
        return replace(joined, low=low, high=high)
    return replace(joined, from_low=gone.low, from_high=gone.high)
