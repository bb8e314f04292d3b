"""Bags that a recorder split: parts of one run, with static transforms in the first alone."""

import numpy as np

from stillmap.io import read
from stillmap.pipeline import inputs

START, PERIOD, T = 1_600_000_000_000_000_000, 100_000_000, 40  # ns, ns, scans


def pose_at(stamp):
    """Where the robot is: it drives 0.5 m/s along a curve."""
    seconds = (stamp - START) / 1e9
    return (0.5 * seconds, 0.02 * seconds**2, 0.0), 0.08 * seconds


def content_of(messages, seed=1):
    """Scans of a laser and odometry between them, as TF; the laser's place first."""
    rng = np.random.default_rng(seed)
    place = messages.transform(START, "base_link", "laser", *messages.pose((0.3, 0.1, 0.5), 0.2))
    out = [("/tf_static", START - 10**9, messages.tf(place))]
    for k in range(T):
        stamp = START + PERIOD * k
        out.append(("/scan", stamp + 10**6, messages.scan(stamp, rng.uniform(1.0, 9.0, 12))))
        for late in (0, PERIOD // 2):
            pose = messages.pose(*pose_at(stamp + late))
            moved = messages.transform(stamp + late, "odom", "base_link", *pose)
            out.append(("/tf", stamp + late + 2 * 10**6, messages.tf(moved)))
    return out


def between(content, first, last):
    """The messages that a recorder gets between scans `first` and `last`."""
    limits = START + PERIOD * first, START + PERIOD * last
    return [one for one in content if limits[0] <= one[1] < limits[1]]


def require_equal(a, b):
    for name in ("stamp_ns", "offset", "points", "hit", "T_base_sensor", "T_odom_base", "sensor"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def test_a_split_bag_is_the_whole_one(bag, messages):
    content = content_of(messages)
    whole = read(bag(content))
    spans = ((-20, 15), (15, 26), (26, T))
    paths = [
        str(bag(between(content, *span), f"part_{number}")) for number, span in enumerate(spans)
    ]
    joined = inputs.read(paths[::-1])
    require_equal(joined, whole)
    assert joined.source.base_frame == "base_link"
    assert [one.scans for one in joined.source.parts] == [15, 11, 14]
    assert joined.source.warnings == whole.source.warnings
