"""Sparsification of the pose graph in 2D: of many passes through a place a few stay."""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Bool, Float, Index, Int64
from stillmap.slam.loop_candidates import MIN_LOOP_TRAVEL
from stillmap.slam.loop_closure import LoopState
from stillmap.slam.loop_verification import CLOSURE_ROTATION, CLOSURE_TRANSLATION, SUBMAP_TRAVEL
from stillmap.slam.types import LoopClosure, LoopContext

_LATEST = 4  # stretches of other passes that stay at a place, the latest, besides the first
_PLACE_DISTANCE, _PLACE_ANGLE = 1.5, 0.8  # m and rad between keyframes that show one place
_RECENT = 50.0  # m of travel of which all stays: its loops are still compared with new ones
_STEP = 0.05  # m or rad: between keyframes, scans of a robot that stands are not needed
_ROWS = 256  # of a matrix of distances


class AnchoredPoses:
    """The spaced scans in the pose graph, by their numbers, and those that left it."""

    def __init__(self) -> None:
        self._graph = np.zeros(0, np.int64)  # numbers of the scans in the graph
        self._left = np.zeros(0, np.int64)  # numbers of those that left it
        self._anchor = np.zeros(0, np.int64)  # number of the scan with which each of them moves
        self._relative = np.zeros((0, 3))  # x, y, heading in its frame

    def remove(self, stay: Bool, poses: Float) -> None:
        """Take scans out of the graph, which from now on move with the nearest one that stays.

        Args:
            stay: (K,) of the scans in the graph, some of them new.
            poses: (K, 3, 3) T_map_base of them.
        """
        every, graph = self.place(poses), self._extend_to(len(poses))
        staying = graph[stay]
        again = ~np.isin(self._anchor, staying)
        leaving = np.concatenate([self._left[again], graph[~stay]])
        anchor = staying[find_nearest(every[leaving], every[staying])]
        relative = se2.parameters(se2.inverse(every[anchor]) @ every[leaving])
        self._left = np.concatenate([self._left[~again], leaving])
        self._anchor = np.concatenate([self._anchor[~again], anchor])
        self._relative = np.concatenate([self._relative[~again], relative])
        self._graph = staying

    def place(self, poses: Float) -> Float:
        """(S, 3, 3) T_map_base of all scans, by the poses (K, 3, 3) of those in the graph, some of
        them new."""
        graph = self._extend_to(len(poses))
        every = np.empty((len(graph) + len(self._left), 3, 3))
        every[graph] = poses
        every[self._left] = every[self._anchor] @ se2.matrix(*self._relative.T)
        return every

    def _extend_to(self, count: int) -> Int64:
        """(K,) numbers of the scans in the graph, with those that were added since."""
        known = len(self._graph) + len(self._left)
        return np.append(self._graph, known + np.arange(count - len(self._graph)))


def select_scans(context: LoopContext, state: LoopState) -> Bool:
    """(S,) the spaced scans that stay.

    Stretches of `SUBMAP_TRAVEL` stay or leave whole: a submap needs all scans of one. Those stay
    that first showed a place, the latest few that show it, and those that no loop ties to others.

    Args:
        context: all spaced scans.
        state: loops of its keyframes, and their corrected poses.
    """
    keyframes, stretch = context.keyframes, (context.travelled // SUBMAP_TRAVEL).astype(np.int64)
    travelled, of = context.travelled[keyframes], stretch[keyframes]
    near = [
        alike[np.abs(travelled[alike] - travelled[k]) > MIN_LOOP_TRAVEL]
        for k, alike in enumerate(_iter_near(state.poses))
    ]
    passes = np.unique(of)
    stay = _find_indispensable(travelled, of, keyframes, state.fitting)
    stay |= _select_passes(passes, of, near, 1, np.zeros(len(of), np.bool_))
    stay |= _select_passes(passes[::-1], of, near, _LATEST, stay)
    is_recent = context.travelled > context.travelled[-1] - _RECENT
    out: Bool = is_recent | np.isin(stretch, of[stay])
    return out & ~_find_standing(context.poses, keyframes)


def _iter_near(poses: Float) -> Iterator[Index]:
    """For each of the poses (K, 3, 3) those that show the same place, itself among them."""
    for away, turn in _iter_distances(poses, poses):
        for row in (away < _PLACE_DISTANCE) & (turn < _PLACE_ANGLE):
            yield np.flatnonzero(row)


def _iter_distances(poses: Float, among: Float) -> Iterator[tuple[Float, Float]]:
    """(n, K) m and rad between some of the poses (N, 3, 3) after others and poses (K, 3, 3)."""
    x, known = se2.parameters(poses), se2.parameters(among)
    for first in range(0, len(x), _ROWS):
        rows = x[first : first + _ROWS, None]
        away = np.hypot(rows[..., 0] - known[:, 0], rows[..., 1] - known[:, 1])
        yield away, np.abs(se2.wrap(rows[..., 2] - known[:, 2]))


def _select_passes(passes: Index, of: Index, near: Sequence[Index], most: int, stay: Bool) -> Bool:
    """(K,) keyframes of the first passes through each place.

    Args:
        passes: all stretches, in the order in which they are taken.
        of: (K,) stretch of each keyframe.
        near: keyframes that show the same place as each.
        most: passes of a place, about.
        stay: (K,) keyframes that stay anyhow.
    """
    chosen = np.zeros(len(of), np.bool_)
    for stretch in passes:
        members = np.flatnonzero(of == stretch).tolist()
        is_needed = (len(np.unique(of[near[k][chosen[near[k]]]])) < most for k in members)
        if stay[members].any() or any(is_needed):
            chosen[members] = True
    return chosen


def _find_indispensable(
    travelled: Float, of: Index, keyframes: Index, fitting: Sequence[LoopClosure]
) -> Bool:
    """(K,) keyframes of recent stretches, and of those that no loop ties to others."""
    ends = [(closure.earlier, closure.later) for closure in fitting]
    at = np.searchsorted(keyframes, np.array(ends, np.intp).reshape(-1, 2))
    recent = travelled > travelled[-1] - _RECENT
    return np.asarray(recent | ~np.isin(of, of[at]))


def _find_standing(poses: Float, keyframes: Index) -> Bool:
    """(S,) scans from about where the scan before was taken, which are no keyframes."""
    x = se2.parameters(poses)
    step = np.hypot(*np.diff(x[:, :2], axis=0).T) + np.abs(se2.wrap(np.diff(x[:, 2])))
    standing = np.append(False, step < _STEP)
    standing[[*keyframes, -1]] = False
    return standing


def find_nearest(poses: Float, among: Float) -> Index:
    """(n,) the nearest ones among poses (K, 3, 3) of poses (n, 3, 3), by m and rad."""
    rows = [np.argmin(away + turn, axis=1) for away, turn in _iter_distances(poses, among)]
    return np.concatenate([np.zeros(0, np.intp), *rows])


def select_state(state: LoopState, keyframes: Index, stay: Bool) -> LoopState:
    """The loops between the scans that stay, with their new numbers.

    A loop to an earlier keyframe that leaves becomes one to the nearest that stays.

    Args:
        state: loops of the keyframes.
        keyframes: (K,) scans.
        stay: (S,) the scans that stay.
    """
    at = np.flatnonzero(stay[keyframes])
    number = np.cumsum(stay) - 1  # of each scan from now on
    is_fitting = set(map(id, state.fitting))
    attempted, decided_on, fitting = [], [], []
    for attempt, decided in zip(state.attempted, state.found, strict=True):
        moved = _move_closure(decided, state.poses, keyframes, at)
        if moved is None or not stay[decided.later]:
            continue
        earlier, later = (int(number[k]) for k in (moved.earlier, moved.later))
        new = dataclasses.replace(moved, earlier=earlier, later=later)
        decided_on.append(new)
        attempted.append(dataclasses.replace(new, rejected=attempt.rejected))
        if id(decided) in is_fitting:
            fitting.append(new)
    return LoopState(state.poses[at], attempted, decided_on, fitting)


def _move_closure(
    closure: LoopClosure, poses: Float, keyframes: Index, at: Index
) -> LoopClosure | None:
    """A closure with one of the keyframes `at` for the earlier one; None: none of them is near."""
    earlier, later = np.searchsorted(keyframes, [closure.earlier, closure.later])
    if np.isin(earlier, at):
        return closure
    before = at[at < later]
    if closure.rejected or not len(before):
        return None
    k = before[find_nearest(poses[earlier][None], poses[before])[0]]
    between = se2.inverse(poses[k]) @ poses[earlier]
    if np.hypot(*between[:2, 2]) > _PLACE_DISTANCE:
        return None
    # both are tied to what is around them by loops
    floor = np.square([CLOSURE_TRANSLATION] * 2 + [CLOSURE_ROTATION])
    T, covariance = between @ closure.T, closure.covariance + np.diag(floor)
    return dataclasses.replace(closure, earlier=int(keyframes[k]), T=T, covariance=covariance)
