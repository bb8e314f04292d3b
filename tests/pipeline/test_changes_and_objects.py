"""What came or left is no moving object; somebody who stood there for long and walked away is."""

from dataclasses import replace

import numpy as np
import pytest
from recordings import of_one_sensor

from stillmap.pipeline.final_map import _is_change
from stillmap.tracking import MovingObject

BEAMS = 10  # of each scan, all of them on the object


def made_up(xy):
    n = len(xy)
    recording = of_one_sensor(
        np.arange(n) * 10**8,
        BEAMS * np.arange(n + 1),
        np.ones((BEAMS * n, 2), np.float32),
        np.ones(BEAMS * n, bool),
    )
    one = MovingObject(
        id=0,
        scan=np.arange(n),
        stamp_ns=recording.stamp_ns,
        xy=np.asarray(xy, float),
        velocity=np.zeros((n, 2)),
        size=(0.4, 0.4),
        beams=np.arange(BEAMS * n),
        p_dynamic=1.0,
    )
    return recording, one


def stands(seconds):
    return [(0.0, 0.0)] * round(10 * seconds)


def walks(metres):
    return [(x, 0.0) for x in np.arange(0.0, metres, 0.1)]


def beams_of(scans):
    return np.flatnonzero(np.repeat(scans, BEAMS))


@pytest.mark.parametrize(("metres", "is_change"), [(4.0, False), (1.0, True), (0.0, True)])
def test_who_stands_in_a_changed_place_and_walks_away_is_a_mover(metres, is_change):
    recording, one = made_up(stands(20) + walks(metres))
    changed = beams_of(np.arange(recording.n_scans) < 200)
    assert _is_change(one, changed, recording) == is_change


def test_who_is_hardly_in_changed_places_is_a_mover():
    recording, one = made_up(stands(20))
    assert not _is_change(one, beams_of(np.arange(recording.n_scans) < 90), recording)
    assert _is_change(one, beams_of(np.arange(recording.n_scans) < 110), recording)


def test_single_beams_beside_a_changed_place_are_of_what_changed():
    """Scans count by most of their beams: these scatter, and so does the centre."""
    recording, one = made_up(stands(20))
    xy = np.random.default_rng(0).normal(scale=2.0, size=one.xy.shape)
    changed = np.flatnonzero(np.arange(recording.n_beams) % BEAMS >= 4)
    assert _is_change(replace(one, xy=xy), changed, recording)
