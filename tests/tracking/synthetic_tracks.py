"""Moving points that somebody made up, and who they are of."""

import numpy as np

from stillmap.tracking.clustering import DynamicPoints, _cluster

RATE = 5.0


def watched(ways, visible=None, seconds=8.0, points=5, radius=0.12, seed=0):
    """What is seen of things that go their ways.

    Args:
        ways: functions of seconds that give x, y.
        visible: of a thing and seconds: whether it is seen then; None: always.
        seconds: from the first scan to the last.
        points: on each thing in each scan, on an arc of `radius` that faces the origin.

    Returns:
        The points, and whose each is.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 1.0 / RATE)
    scan, xy, who = [], [], []
    for s, now in enumerate(t):
        seen = []
        for i, way in enumerate(ways):
            if visible is not None and not visible(i, now):
                continue
            middle = np.array(way(now), float)
            facing = np.arctan2(-middle[1], -middle[0])
            angle = facing + np.linspace(-1.0, 1.0, points)
            arc = middle + radius * np.column_stack([np.cos(angle), np.sin(angle)])
            seen.append((i, arc + rng.normal(0.0, 0.01, arc.shape)))
        if not seen:
            continue
        mine = np.concatenate([np.full(len(arc), i) for i, arc in seen])
        all_xy = np.concatenate([arc for _, arc in seen])
        order = np.argsort(np.arctan2(all_xy[:, 1], all_xy[:, 0]), kind="stable")
        scan += [s] * len(order)
        xy.append(all_xy[order])
        who.append(mine[order])
    made = points_of(t, np.array(scan), np.concatenate(xy), np.zeros((len(t), 2)))
    return made, np.concatenate(who)


def points_of(seconds, scan, xy, sensor):
    """Dynamic points seen from these positions (T, 2)."""
    distance = np.linalg.norm(xy - sensor[scan], axis=1)
    cluster, first = _cluster(scan, xy, distance), np.searchsorted(scan, np.arange(len(sensor) + 1))
    return DynamicPoints(seconds, scan, np.arange(len(scan)), xy, distance, sensor, cluster, first)


def one_each(owner, who):
    """Whether every thing has a number of its own, and no other."""
    pairs = np.unique(np.column_stack([owner, who]), axis=0)
    things = len(np.unique(who))
    return len(pairs) == things == len(np.unique(owner)) and owner.min() >= 0
