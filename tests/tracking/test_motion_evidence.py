"""Movers and clutter, told apart by their tracks and by what is common in a recording."""

import numpy as np
import pytest
from recordings import of_one_sensor

from stillmap.tracking.motion_evidence import (
    TrackEvidence,
    apply_motion_evidence,
    compute_log_ratio,
)

ANGLES = np.radians(np.arange(-180.0, 180.0, 0.5))
ROOM = 8.0  # m to the wall
NOISE_STD = 0.01  # m
RATE = 10.0


def log_ratio(**changes):
    """Of one track: 40 looks at something thick, seen from first to last, that stands."""
    usual = {"looks": 40, "hits": 6, "missed": 0, "windows": 3, "moving": 0, "open_ends": 0}
    values = (usual | {"slides": 0} | changes).values()
    return float(compute_log_ratio(TrackEvidence(*(np.array([float(x)]) for x in values)))[0])


def test_each_kind_of_evidence_counts_in_its_direction():
    assert log_ratio(moving=3) > log_ratio(moving=1) > log_ratio()
    assert log_ratio(missed=20) < log_ratio(missed=4) < log_ratio()
    assert log_ratio(open_ends=2) < log_ratio(open_ends=1) < log_ratio()


def recorded(things, seconds=20.0):
    """Scans of a standing laser in a round room.

    Args:
        things: functions of seconds that give x, y, radius, or None where nothing is to be seen.

    Returns:
        The recording, and whose each beam is: -1 the wall's.
    """
    times = np.arange(0.0, seconds, 1.0 / RATE)
    ranges = np.full((len(times), len(ANGLES)), ROOM)
    who = np.full(ranges.shape, -1)
    for t, now in enumerate(times):
        for i, thing in enumerate(things):
            if (seen := thing(now)) is None:
                continue
            x, y, radius = seen
            off = np.angle(np.exp(1j * (ANGLES - np.arctan2(y, x))))
            far = np.hypot(x, y)
            on = (np.abs(np.sin(off)) * far < radius) & (np.abs(off) < 1.0) & (far < ranges[t])
            ranges[t, on], who[t, on] = far, i
    rng = np.random.default_rng(0)
    ranges += rng.normal(0.0, 0.01, ranges.shape)
    points = ranges[..., None] * np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=-1)
    recording = of_one_sensor(
        (times * 1e9).astype(np.int64),
        np.arange(len(times) + 1, dtype=np.int64) * len(ANGLES),
        points.reshape(-1, 2).astype(np.float32),
        np.ones(ranges.size, bool),
    )
    return recording, who.ravel()


def apply(recording, p_static):
    poses = np.tile(np.eye(3), (recording.n_scans, 1, 1))
    return apply_motion_evidence(recording, poses, p_static, NOISE_STD)


def judged(things):
    """P(static) of the beams on each thing afterwards, and the movers; before it was 0.05."""
    recording, who = recorded(things)
    p_static = np.where(who >= 0, 0.05, 0.95).astype(np.float32)
    found, movers = apply(recording, p_static)
    assert np.array_equal(found[who < 0], p_static[who < 0])
    return [float(found[who == i].mean()) for i in range(len(things))], movers


def walker(y, speed=1.0, begin=-6.0):
    return lambda s: (begin + speed * s, y, 0.2) if abs(begin + speed * s) < 6.0 else None


def flicker(x, y, period, radius=0.1):
    """A chair's leg: half of the looks hit it, in turns of `period` seconds."""
    return lambda s: (x, y, radius) if int(s / period) % 2 == 0 else None


CHAIRS = [flicker(3.0 * np.cos(a), 3.0 * np.sin(a), p) for a, p in ((0.3, 0.3), (1.4, 0.5))]
CHAIRS += [flicker(2.0 * np.cos(a), 2.0 * np.sin(a), p) for a, p in ((2.4, 0.4), (4.0, 0.6))]


def test_walkers_stay_dynamic_and_furniture_becomes_static():
    (one, other, *chairs), movers = judged([walker(-2.5), walker(4.0, -0.8, 6.0), *CHAIRS])
    assert one < 0.1
    assert other < 0.1
    assert min(chairs) > 0.7
    near_chair = np.linalg.norm(movers.xy[:, None] - [[-1.3, -1.5]], axis=-1).min()
    assert len(movers.xy) > 20
    assert near_chair > 0.5


def test_where_nobody_walks_all_is_furniture():
    found, movers = judged(CHAIRS)
    assert min(found) > 0.9
    assert len(movers.xy) == 0


def test_one_who_stands_among_walkers_is_a_mover():
    crowd = [walker(y, 0.7) for y in (-4.5, -3.5, -2.5, 3.0, 4.0)]
    (stands, *_), _ = judged([lambda _: (0.0, 1.5, 0.2), *crowd])
    assert stands < 0.2


def test_no_dynamic_beams_no_work():
    recording, who = recorded([walker(2.0)])
    p_static = np.ones(len(who), np.float32)
    found, movers = apply(recording, p_static)
    assert np.array_equal(found, p_static)
    assert len(movers.xy) == 0


@pytest.mark.parametrize("batch", [1, 3])
def test_tracks_may_be_looked_at_in_any_number_at_once(batch, monkeypatch):
    expected, _ = judged([walker(-2.5), *CHAIRS])
    monkeypatch.setattr("stillmap.tracking.motion_evidence._BATCH", batch)
    found, _ = judged([walker(-2.5), *CHAIRS])
    assert found == expected


def test_a_walker_is_dynamic_where_his_cells_do_not_say_so():
    recording, who = recorded([walker(-2.5)])
    p_static = np.where(who >= 0, 0.05, 0.95).astype(np.float32)
    scan = np.repeat(np.arange(recording.n_scans), len(ANGLES))
    unknown = (who == 0) & (scan % 4 == 0)
    p_static[unknown] = 0.8
    found, _ = apply(recording, p_static)
    assert np.mean(found[unknown] < 0.5) > 0.9
    np.testing.assert_array_equal(found[who < 0], p_static[who < 0])
